"""Collaborative detectors, by name."""

from __future__ import annotations

from collections.abc import Callable

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
from robosac.detectors.embedded import EmbeddedDetector, WeightsError

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
    "WeightsError",
    "available",
    "load",
]
