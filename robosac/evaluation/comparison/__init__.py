"""Defences against attacks and numbers of attackers, all judged on the same frames."""

from robosac.evaluation.comparison import kept
from robosac.evaluation.comparison.playing import Plan
from robosac.evaluation.comparison.report import write_comparison
from robosac.evaluation.comparison.rows import Row
from robosac.evaluation.comparison.running import compare_defenses, compare_plans
from robosac.evaluation.comparison.settings import DEFENSES, FULL, QUICK, Extent, Setting, built, lacks_witness
from robosac.evaluation.comparison.worlds import write_worlds

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
    "compare_plans",
    "kept",
    "lacks_witness",
    "write_comparison",
    "write_worlds",
]
