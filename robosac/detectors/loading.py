"""Detectors that ship, that weights files are for, or that the user brings along."""

from __future__ import annotations

from pathlib import Path

from robosac.detectors.base import Detector
from robosac.detectors.embedded import NAME as EMBEDDED
from robosac.detectors.embedded import EmbeddedDetector, WeightsError, read_weights
from robosac.detectors.v2xsim import FAMILY as V2XSIM
from robosac.detectors.v2xsim import V2XSimDetector
from robosac.plugins import Kind

DETECTORS: Kind[Detector] = Kind("detector", str(__package__), Detector, forms="a weights file, or module:callable")
DEFAULT_DETECTOR = EMBEDDED


def available() -> tuple[str, ...]:
    """Names of the detectors whose weights ship."""
    return tuple(DETECTORS.shipped)


def load(detector: str = DEFAULT_DETECTOR) -> Detector:
    """Load a detector.

    Parameters
    ----------
    detector : str
        A name of `available`, the path of a weights file, an entry point of the group ``robosac.detectors``, or
        ``module:callable``, where the callable takes no arguments and returns a detector.

    Raises
    ------
    WeightsError
        If the weights cannot be used.
    ValueError
        If there is no such detector.
    """
    if detector not in DETECTORS.shipped and Path(detector).exists():
        return _open_weights(Path(detector))
    return DETECTORS.make(detector)


def _open_weights(path: Path) -> Detector:
    """The detector that a weights file is for, with those weights."""
    _, recipe = read_weights(path)
    name = str(recipe.get("detector"))
    if name == EMBEDDED:
        return EmbeddedDetector(path)
    if name.startswith(f"{V2XSIM}-"):
        return V2XSimDetector(path)
    raise WeightsError(f"{path} is for an unknown detector, {name!r}")
