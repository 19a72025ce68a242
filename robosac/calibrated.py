"""What belongs to a detector beside its weights, once `robosac.calibration` has made it: calibration and witness."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from robosac.defenses.group_testing import Calibration, CalibrationError
from robosac.detectors import DetectorInfo
from robosac.detectors.base import Precision
from robosac.detectors.weights_file import WeightsError
from robosac.detectors.witness import Witness
from robosac.screening import FRAME_PERIOD_S, Bounds, Screening


def calibration_of(info: DetectorInfo) -> Calibration:
    """The calibration beside a detector's weights.

    Raises
    ------
    CalibrationError
        If there is none, it is damaged, or it belongs to other weights; or the witness beside it is or does.
    """
    if info.calibration is None:
        raise CalibrationError(
            f"the detector {info.name} is not calibrated for group testing: make a calibration beside its weights "
            "with robosac calibrate"
        )
    try:
        calibration = _read(info.calibration, info.calibration.stat().st_mtime_ns)
        if calibration.weights_digest != info.weights_digest:
            raise CalibrationError(
                f"{info.calibration} belongs to weights with the digest {calibration.weights_digest:.12}..., not to "
                f"{info.name} with {info.weights_digest:.12}...: calibrate again"
            )
        return replace(calibration, witnessed=witness_of(info) is not None)
    except (OSError, CalibrationError, WeightsError) as error:
        # a gateway tells its clients what is wrong, but not where its files lie
        raise CalibrationError(str(error).replace(f"{info.calibration.parent}{os.sep}", "")) from error


def calibration_fault(info: DetectorInfo) -> str | None:
    """Why the calibration beside a detector's weights cannot be used; None if it can be, or there is none."""
    if info.calibration is None:
        return None
    try:
        calibration_of(info)
    except CalibrationError as error:
        return str(error)
    return None


def calibration_digest(info: DetectorInfo) -> str | None:
    """SHA-256 (hexadecimal) of the calibration beside a detector's weights, and of the witness, if there is one, after
    it. None if there is no calibration to be read.
    """
    if info.calibration is None:
        return None
    try:
        files = [info.calibration, *([info.witness] if info.witness is not None else ())]
        return _digest(*((path, path.stat().st_mtime_ns) for path in files))
    except OSError:
        return None


def digest_beside(info: DetectorInfo) -> str:
    """SHA-256 (hexadecimal) of what there is beside a detector's weights: attacks and defences read it.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    files = [path for path in (info.calibration, info.witness) if path is not None and path.exists()]
    return _digest(*((path, path.stat().st_mtime_ns) for path in files))


def witness_of(info: DetectorInfo) -> Witness | None:
    """The witness network beside a detector's weights; None if there is none.

    Raises
    ------
    robosac.detectors.weights_file.WeightsError
        If it is damaged, or belongs to other weights.
    OSError
        If it cannot be read.
    """
    if info.witness is None:
        return None
    return _open(info.witness, info.witness.stat().st_mtime_ns, info)


def without_witness(name: str) -> str:
    """In one line, what group testing goes without on the detector of that name, which has no witness."""
    return f"{name} has no witness, so group testing judges no single objects with it: robosac witness makes one"


@lru_cache(maxsize=16)
def _digest(*files: tuple[Path, int]) -> str:  # with the times of their last changes
    return hashlib.sha256(b"".join(path.read_bytes() for path, _ in files)).hexdigest()


@lru_cache(maxsize=16)
def _read(path: Path, changed: int) -> Calibration:  # noqa: ARG001 (a changed file is read again)
    return Calibration.read(path)


_witnesses: dict[tuple[Path, str, Precision], tuple[int, str, Witness]] = {}


def _open(path: Path, changed: int, info: DetectorInfo) -> Witness:
    where = path, info.device, info.precision
    known = _witnesses.get(where)
    if known is None or known[:2] != (changed, info.weights_digest):
        known = _witnesses[where] = (changed, info.weights_digest, Witness.open(path, info))
    return known[2]


def screening_for(info: DetectorInfo, frame_period_s: float = FRAME_PERIOD_S) -> Screening:
    """The tests of messages for frames so far apart.

    They know of honest messages what the file beside a detector's weights says. Where it says nothing, or there is none
    that belongs to the weights, nothing is known.
    """
    known: Mapping[str, Bounds] = {}
    if info.calibration is not None:
        with suppress(OSError, KeyError, TypeError, ValueError):
            known = _bounds(info.calibration, info.calibration.stat().st_mtime_ns, info.weights_digest)
    return Screening(known, frame_period_s)


@lru_cache(maxsize=16)
def _bounds(path: Path, changed: int, weights_digest: str) -> dict[str, Bounds]:  # noqa: ARG001 (as above)
    content = json.loads(path.read_text())
    messages = content.get("messages", {}) if content["weights_digest"] == weights_digest else {}
    return {name: Bounds.from_json(fields) for name, fields in messages.items()}
