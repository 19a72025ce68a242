"""Defences against attacks and numbers of attackers, all judged on the same frames."""

from robosac.evaluation.comparison.playing import Plan
from robosac.evaluation.comparison.report import write_comparison
from robosac.evaluation.comparison.rows import Row
from robosac.evaluation.comparison.running import compare_defenses
from robosac.evaluation.comparison.settings import DEFENSES, FULL, QUICK, Extent, Setting, built

__all__ = [
    "DEFENSES",
    "FULL",
    "QUICK",
    "Extent",
    "Plan",
    "Row",
    "Setting",
    "built",
    "compare_defenses",
    "write_comparison",
]
