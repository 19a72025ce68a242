"""The paper's experiments, each a function of a `Context` that returns a `Section` of the report."""

from __future__ import annotations

from collections.abc import Callable

from robosac.evaluation.experiments.common import FULL, QUICK, Context, Scale
from robosac.evaluation.experiments.detection import ablation, budgets, generalisation, qualitative, trade_off
from robosac.evaluation.experiments.sequences import teams
from robosac.evaluation.experiments.theory import derivation, numerical, ratio_estimation
from robosac.evaluation.report import Section

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

HEAD = """# Every experiment of the paper, on the synthetic intersection

Made by `{command}` in {minutes:.0f} minutes.

**Average precision on this synthetic world is not comparable with the paper's on V2X-Sim.** World, detector and attack
differ. What compares is put side by side: orderings, ratios to the bounds, sampling steps, success rates, estimated
ratios. The paper is *Among Us: Adversarially Robust Collaborative Perception by Consensus* (ICCV 2023).
"""
"""What the report begins with."""

__all__ = ["EXPERIMENTS", "FULL", "HEAD", "QUICK", "Context", "Scale"]
