"""The calibration that belongs to a detector: beside its weights, once `robosac.calibration` has made it."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path

from robosac.defenses.group_testing import Calibration, CalibrationError
from robosac.detectors import DetectorInfo
from robosac.screening import Bounds, Screening


def calibration_of(info: DetectorInfo) -> Calibration:
    """The calibration beside a detector's weights.

    Raises
    ------
    CalibrationError
        If there is none, it is damaged, or it belongs to other weights.
    """
    if info.calibration is None:
        raise CalibrationError(
            f"the detector {info.name} is not calibrated for group testing: make a calibration beside its weights "
            "with robosac calibrate"
        )
    try:
        changed = info.calibration.stat().st_mtime_ns
    except OSError as error:
        raise CalibrationError(f"{info.calibration} cannot be read: {error}") from error
    calibration = _read(info.calibration, changed)
    if calibration.weights_digest != info.weights_digest:
        raise CalibrationError(
            f"{info.calibration.name} belongs to weights with the digest {calibration.weights_digest:.12}..., not to "
            f"{info.name} with {info.weights_digest:.12}...: calibrate again"
        )
    return calibration


def calibration_digest(info: DetectorInfo) -> str | None:
    """SHA-256 (hexadecimal) of the file beside a detector's weights; None if there is none to be read."""
    if info.calibration is None:
        return None
    try:
        return _digest(info.calibration, info.calibration.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=16)
def _digest(path: Path, changed: int) -> str:  # noqa: ARG001 (of a changed file it is another)
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache(maxsize=16)
def _read(path: Path, changed: int) -> Calibration:  # noqa: ARG001 (a changed file is read again)
    return Calibration.read(path)


def screening_for(info: DetectorInfo) -> Screening:
    """The tests of messages, with what the file beside a detector's weights says of honest ones.

    Where it says nothing, or there is none that belongs to the weights, nothing is known of them.
    """
    if info.calibration is None:
        return Screening()
    try:
        return Screening(_bounds(info.calibration, info.calibration.stat().st_mtime_ns, info.weights_digest))
    except (OSError, KeyError, TypeError, ValueError):
        return Screening()


@lru_cache(maxsize=16)
def _bounds(path: Path, changed: int, weights_digest: str) -> dict[str, Bounds]:  # noqa: ARG001 (as above)
    content = json.loads(path.read_text())
    messages = content.get("messages", {}) if content["weights_digest"] == weights_digest else {}
    return {name: Bounds.from_json(fields) for name, fields in messages.items()}
