"""How a detector is made ready for `robosac.defenses.GroupTesting`: likelihoods of what its tests show."""

from robosac.calibrated import calibration_digest, calibration_of
from robosac.calibration.fit import TooFewVerdicts, fit
from robosac.calibration.making import Recipe, ReliabilityBin, calibrate
from robosac.calibration.verdicts import Verdicts, collect, validation_stretches

__all__ = [
    "Recipe",
    "ReliabilityBin",
    "TooFewVerdicts",
    "Verdicts",
    "calibrate",
    "calibration_digest",
    "calibration_of",
    "collect",
    "fit",
    "validation_stretches",
]
