"""Detectors by name, by a weights file, or brought along by the user.

A class in a module of this package ships under its ``name``, if it has one, and is then made without arguments. One
that ``opens`` weights files lists the detectors that they are for, and is then made with the file's path.
"""

from __future__ import annotations

import os
from pathlib import Path
from traceback import extract_tb
from typing import get_args

from robosac.detectors.base import (
    DEFAULT_DETECTOR,
    Batching,
    Detector,
    DetectorError,
    Joining,
    Placeable,
    Precise,
    Precision,
    PreparedFrame,
    Preparer,
    blank,
    check_boxes,
    split_precision,
)
from robosac.detectors.declared import check_info
from robosac.detectors.device import CPU, as_device
from robosac.detectors.recorded import EACH, MOST
from robosac.detectors.weights_file import WeightsError, read_weights
from robosac.faults import describe
from robosac.plugins import Kind, classes

DETECTORS: Kind[Detector] = Kind("detector", str(__package__), Preparer, forms="a weights file, or module:callable")


def available() -> tuple[str, ...]:
    """Names of the detectors that ship."""
    return tuple(DETECTORS.shipped)


def load(detector: str | os.PathLike[str] = DEFAULT_DETECTOR, device: str = "cpu") -> Detector:
    """Load a detector.

    It is checked for what a gateway needs of it, `Preparer`. Whoever encodes scans or attacks asks
    `robosac.attacks.lacking` first.

    Parameters
    ----------
    detector : str or path
        A name of `available`, the path of a weights file, an entry point of the group ``robosac.detectors``, or
        ``module:callable``, where the callable takes no arguments and returns a detector. After it ``@bfloat16`` may
        stand, or another precision in which the detector can decode.
    device : str
        Where it computes, by torch's name: ``cpu``, ``cuda``, ``cuda:1``.

    Raises
    ------
    WeightsError
        If the weights cannot be used.
    ValueError
        If there is no such detector, it lacks what a gateway needs, its ``info`` cannot be, or it cannot decode in that
        precision or compute on that device.
    """
    elsewhere = as_device(device) != CPU
    loaded = _load(os.fspath(detector))
    if not elsewhere:
        return loaded
    if not isinstance(loaded, Placeable):
        raise ValueError(f"{detector} cannot compute on {device}: it has no method on_device")
    return loaded.on_device(device)


def warm_up(detector: Preparer) -> None:
    """Run frames of zeros through a detector, so that the first one is as fast as the next.

    Raises
    ------
    DetectorError
        If what it detects are no boxes, or it is the user's own and fails.
    """
    try:
        ego, teammate = blank(detector.info, "ego"), blank(detector.info, "teammate")
        for _ in range(2):
            prepared = detector.prepare(ego, {"a": teammate, "b": teammate})
            if not callable(getattr(prepared, "detect", None)):
                raise DetectorError(f"prepare must return a frame to detect in, got a {type(prepared).__name__}")
            check_boxes(prepared.detect())
            check_boxes(prepared.detect(["a", "b"]))
            if isinstance(prepared, Batching) and prepared.worth > 1:
                for size in (*range(1, EACH + 1), MOST):
                    detector.prepare(ego, {str(i): teammate for i in range(size)})
                _warm_up_batches(prepared, detector.prepare(ego, {"a": teammate, "b": teammate}))
    except DetectorError as error:
        raise DetectorError(f"{detector.info.name}: {error}") from error
    except Exception as error:  # the user's code may raise anything
        if type(detector).__module__.startswith(f"{__package__}."):
            raise
        at = extract_tb(error.__traceback__)[-1]
        said = f"{describe(error)} ({Path(at.filename).name}, line {at.lineno})"
        raise DetectorError(f"{detector.info.name} cannot answer a frame of zeros: {said}") from error


def _warm_up_batches(prepared: Batching, another: PreparedFrame) -> None:
    """Decode as many subsets at once as one frame may want, or several."""
    sizes, subset = range(2, prepared.worth + 1), ["a", "b"]
    for size in sizes:
        prepared.detect_all([subset] * size)
    if isinstance(prepared, Joining):
        for size in (*sizes, *(2**power for power in range(prepared.worth.bit_length(), MOST.bit_length()))):
            prepared.detect_together([(prepared, [subset] * (size - 1)), (another, [subset])])


def _load(detector: str) -> Detector:
    plain, precision = split_precision(detector)
    there = os.path.exists(detector)  # noqa: PTH110 (Path raises for a long name)
    if plain != detector and not there:
        if split_precision(plain)[0] != plain and not os.path.exists(plain):  # noqa: PTH110 (as above)
            raise ValueError(f"{detector} names more than one precision")
        loaded = _load(plain)
        if not isinstance(loaded, Precise):
            raise ValueError(f"{plain} cannot decode in {precision}: it has no method in_precision")
        return loaded.in_precision(precision)
    if detector not in DETECTORS.shipped and there:
        return _open_weights(Path(detector))
    whole, _, last = detector.rpartition("@")
    if whole in DETECTORS.shipped or whole.endswith(".safetensors"):
        raise ValueError(f"{detector}: the precision must be one of {', '.join(get_args(Precision))}, got {last!r}")
    if detector.endswith(".safetensors") or "/" in detector:
        raise WeightsError(f"there is no file {detector}")
    made = DETECTORS.make(detector)
    check_info(made.info, detector)
    return made


def _open_weights(path: Path) -> Detector:
    """The detector that a weights file is for, with those weights."""
    _, recipe = read_weights(path)
    name = recipe.get("detector")
    for candidate in classes(DETECTORS.package):
        if name in vars(candidate).get("opens", ()):
            opened: Detector = candidate(path)
            return opened
    raise WeightsError(f"{path} is for an unknown detector, {name!r}")
