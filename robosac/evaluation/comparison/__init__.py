"""Defences against attacks and numbers of attackers, all judged on the same frames."""

from robosac.evaluation.comparison.playing import Row, compare_defenses
from robosac.evaluation.comparison.report import write_comparison
from robosac.evaluation.comparison.settings import DEFENSES, FULL, QUICK, Extent, Setting

__all__ = ["DEFENSES", "FULL", "QUICK", "Extent", "Row", "Setting", "compare_defenses", "write_comparison"]
