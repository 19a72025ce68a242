"""Detectors that ship, that weights files are for, or that the user brings along."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robosac import references
from robosac.detectors.base import Detector
from robosac.detectors.embedded import NAME as EMBEDDED
from robosac.detectors.embedded import EmbeddedDetector, WeightsError, read_weights
from robosac.detectors.v2xsim import FAMILY as V2XSIM
from robosac.detectors.v2xsim import V2XSimDetector

_REGISTRY: dict[str, Callable[[], Detector]] = {EMBEDDED: EmbeddedDetector}
DEFAULT_DETECTOR = EMBEDDED


def available() -> tuple[str, ...]:
    """Names of the detectors whose weights ship."""
    return tuple(_REGISTRY)


def load(detector: str = DEFAULT_DETECTOR) -> Detector:
    """Load a detector.

    Parameters
    ----------
    detector : str
        A name of `available`, the path of a weights file, or ``module:callable``, where the callable takes no arguments
        and returns a detector of the user's own.

    Raises
    ------
    WeightsError
        If the weights cannot be used.
    ValueError
        If there is no such detector.
    """
    if detector in _REGISTRY:
        return _REGISTRY[detector]()
    if references.is_reference(detector):
        made = references.make(detector)
        if not isinstance(made, Detector):
            raise ValueError(f"{detector} made no detector but {made!r:.200}")
        return made
    if not Path(detector).exists():
        raise ValueError(
            f"no detector {detector!r}: give one of {', '.join(available())}, a weights file, or module:callable"
        )
    return _open_weights(Path(detector))


def _open_weights(path: Path) -> Detector:
    """The detector that a weights file is for, with those weights."""
    _, recipe = read_weights(path)
    name = str(recipe.get("detector"))
    if name == EMBEDDED:
        return EmbeddedDetector(path)
    if name.startswith(f"{V2XSIM}-"):
        return V2XSimDetector(path)
    raise WeightsError(f"{path} is for an unknown detector, {name!r}")
