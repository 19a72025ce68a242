"""Collaborative detectors, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robosac.detectors.base import (
    AttackSurface,
    Detector,
    DetectorInfo,
    Message,
    PreparedFrame,
    Preparer,
    Role,
    TensorSpec,
)
from robosac.detectors.embedded import NAME as EMBEDDED
from robosac.detectors.embedded import EmbeddedDetector, WeightsError, read_weights
from robosac.detectors.v2xsim import FAMILY as V2XSIM
from robosac.detectors.v2xsim import V2XSimDetector

_REGISTRY: dict[str, Callable[[], Detector]] = {EMBEDDED: EmbeddedDetector}
DEFAULT_DETECTOR = EMBEDDED


def available() -> tuple[str, ...]:
    """Names that `load` knows."""
    return tuple(_REGISTRY)


def load(name: str = DEFAULT_DETECTOR) -> Detector:
    """Load a detector with its shipped weights.

    Raises
    ------
    KeyError
        If there is no detector of that name.
    WeightsError
        If its weights cannot be used.
    """
    return _REGISTRY[name]()


def open_weights(path: Path) -> Detector:
    """The detector that a weights file is for, with those weights.

    Raises
    ------
    WeightsError
        If the file cannot be used, or is for a detector that is not known.
    """
    _, recipe = read_weights(path)
    name = str(recipe.get("detector"))
    if name == EMBEDDED:
        return EmbeddedDetector(path)
    if name.startswith(f"{V2XSIM}-"):
        return V2XSimDetector(path)
    raise WeightsError(f"{path} is for an unknown detector, {name!r}")


__all__ = [
    "DEFAULT_DETECTOR",
    "AttackSurface",
    "Detector",
    "DetectorInfo",
    "EmbeddedDetector",
    "Message",
    "PreparedFrame",
    "Preparer",
    "Role",
    "TensorSpec",
    "V2XSimDetector",
    "WeightsError",
    "available",
    "load",
    "open_weights",
]
