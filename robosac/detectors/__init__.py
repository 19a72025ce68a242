"""Collaborative detectors, by name. What a message holds is there at once; what needs torch, once it is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robosac.detectors.base import (
    DEFAULT_DETECTOR,
    AttackSurface,
    Detector,
    DetectorError,
    DetectorInfo,
    Encoder,
    GeometricSurface,
    Message,
    PreparedFrame,
    Preparer,
    Role,
    TensorSpec,
    blank,
    calibration_beside,
    witness_beside,
)
from robosac.lazy import lazily

if TYPE_CHECKING:
    from robosac.detectors.embedded import EmbeddedDetector
    from robosac.detectors.loading import available, load
    from robosac.detectors.v2xsim import V2XSimDetector
    from robosac.detectors.weights_file import WeightsError
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "EmbeddedDetector": "robosac.detectors.embedded:EmbeddedDetector",
            "V2XSimDetector": "robosac.detectors.v2xsim:V2XSimDetector",
            "WeightsError": "robosac.detectors.weights_file:WeightsError",
            "available": "robosac.detectors.loading:available",
            "load": "robosac.detectors.loading:load",
        },
    )

__all__ = [
    "DEFAULT_DETECTOR",
    "AttackSurface",
    "Detector",
    "DetectorError",
    "DetectorInfo",
    "EmbeddedDetector",
    "Encoder",
    "GeometricSurface",
    "Message",
    "PreparedFrame",
    "Preparer",
    "Role",
    "TensorSpec",
    "V2XSimDetector",
    "WeightsError",
    "available",
    "blank",
    "calibration_beside",
    "witness_beside",
    "load",
]
