"""The calibrated likelihoods of one detector, and the file that holds them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.model import CalibrationError, EvidenceModel
from robosac.files import write_text

FORMAT = 3


@dataclass(frozen=True)
class Calibration:
    """The likelihoods of one detector, at several levels of pose error."""

    detector: str
    weights_digest: str
    """SHA-256 of the weights file that it belongs to, hexadecimal."""
    recipe: Mapping[str, Any]
    """How it was made; JSON values."""
    levels: tuple[EvidenceModel, ...]
    """Ascending pose error."""
    witnessed: bool = False
    """Whether the detector has a witness, so that single objects can be judged; not kept in the file."""

    def at(self, pose_error_m: float) -> EvidenceModel:
        """The level with the least pose error not below this one, metres.

        Raises
        ------
        CalibrationError
            If it was calibrated at none so large.
        """
        for level in self.levels:
            if level.pose_error_m >= pose_error_m:
                return level
        most = max((level.pose_error_m for level in self.levels), default=0.0)
        raise CalibrationError(f"calibrated up to a pose error of {most:g} m, {pose_error_m:g} m is asked for")

    def write(self, path: Path) -> None:
        """Write as JSON."""
        content = {
            "format": FORMAT,
            "detector": self.detector,
            "weights_digest": self.weights_digest,
            "recipe": dict(self.recipe),
            "levels": [
                {
                    "pose_error_m": level.pose_error_m,
                    "kinds": list(level.kinds),
                    "pairs": _rounded(level.pairs),
                    "changes": _rounded(level.changes),
                }
                for level in self.levels
            ],
        }
        write_text(path, json.dumps(content) + "\n")

    @classmethod
    def read(cls, path: Path) -> Calibration:
        """Read what `write` wrote.

        Raises
        ------
        CalibrationError
            If the file cannot be read or is no calibration.
        """
        try:
            content = json.loads(path.read_text())
            if content["format"] != FORMAT:
                raise CalibrationError(f"format {content['format']!r} is unknown")
            levels = [
                EvidenceModel(
                    float(level["pose_error_m"]),
                    tuple(map(str, level["kinds"])),
                    _normalised(level["pairs"]),
                    _normalised(level["changes"]),
                )
                for level in content["levels"]
            ]
            levels.sort(key=lambda level: level.pose_error_m)
            return cls(str(content["detector"]), str(content["weights_digest"]), content["recipe"], tuple(levels))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CalibrationError(f"{path} is no calibration: {error}") from error


def _rounded(table: FloatArray) -> Sequence[Any]:
    values: Sequence[Any] = np.round(table, 6).tolist()
    return values


def _normalised(values: Sequence[Any]) -> FloatArray:
    table = np.asarray(values, dtype=np.float64)
    total: FloatArray = table / table.sum(axis=-1, keepdims=True)
    return total
