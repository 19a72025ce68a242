"""How a detector is made ready for `robosac.defenses.GroupTesting`: likelihoods of what its tests show."""

from robosac.calibration.fit import TooFewVerdicts, fit
from robosac.calibration.making import Recipe, ReliabilityBin, calibrate
from robosac.calibration.verdicts import Verdicts

__all__ = ["Recipe", "ReliabilityBin", "TooFewVerdicts", "Verdicts", "calibrate", "fit"]
