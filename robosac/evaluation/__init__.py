"""How well a perception or a defence does, against the truth of the scenes."""

from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.bounds import BoundsReport, BoundsRow, NoFrames, Sampling, evaluate_bounds

__all__ = ["AveragePrecision", "BoundsReport", "BoundsRow", "NoFrames", "Sampling", "evaluate_bounds"]
