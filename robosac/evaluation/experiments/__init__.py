"""The paper's experiments, each a function of a `Context` that returns a `Section` of the report."""

from __future__ import annotations

from collections.abc import Callable

from robosac.evaluation.experiments.common import FULL, QUICK, Context, Scale, Section, Table
from robosac.evaluation.experiments.detection import ablation, budgets, generalisation, qualitative, trade_off
from robosac.evaluation.experiments.report import write_report
from robosac.evaluation.experiments.sequences import teams
from robosac.evaluation.experiments.theory import derivation, numerical, ratio_estimation

EXPERIMENTS: dict[str, Callable[[Context], Section]] = {
    "derivation": derivation,
    "budgets": budgets,
    "teams": teams,
    "generalisation": generalisation,
    "ablation": ablation,
    "ratio-estimation": ratio_estimation,
    "numerical": numerical,
    "trade-off": trade_off,
    "qualitative": qualitative,
}
"""All experiments by name, in the order of the report."""

__all__ = ["EXPERIMENTS", "FULL", "QUICK", "Context", "Scale", "Section", "Table", "write_report"]
