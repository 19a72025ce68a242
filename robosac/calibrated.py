"""The calibration that belongs to a detector: beside its weights, once `robosac.calibration` has made it."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

from robosac.defenses.group_testing import Calibration, CalibrationError
from robosac.detectors import DetectorInfo


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
    try:
        return None if info.calibration is None else hashlib.sha256(info.calibration.read_bytes()).hexdigest()
    except OSError:
        return None


@lru_cache(maxsize=16)
def _read(path: Path, changed: int) -> Calibration:  # noqa: ARG001 (a changed file is read again)
    return Calibration.read(path)
