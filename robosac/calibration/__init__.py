"""How a detector is made ready for `robosac.defenses.GroupTesting`: likelihoods of what its tests show."""

from robosac.calibration.fit import TooFewVerdicts, fit
from robosac.calibration.making import Recipe, calibrate
from robosac.calibration.reliability import ReliabilityBin
from robosac.calibration.verdicts import Verdicts

__all__ = ["Recipe", "ReliabilityBin", "TooFewVerdicts", "Verdicts", "calibrate", "fit"]
