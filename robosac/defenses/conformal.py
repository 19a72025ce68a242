"""Conformal tests of single teammates with control of false discoveries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from robosac.answers import Reason, Verdict
from robosac.boxes import FloatArray
from robosac.defenses.benign_scores import SINGLE_TEAMMATE
from robosac.defenses.memoryless import Memoryless, one_each, unite
from robosac.defenses.protocol import Conversation, Rejection, State, conclude

DEFAULT_RATE = 0.05


class Conformal(Memoryless):
    """Calibrated tests of every teammate with control of false discoveries.

    The idea of MADE (IROS 2024): calibrated tests of each teammate, and a bound on honest ones accused.

    1. Each teammate is fused alone with the ego. Its match loss is one minus the Jaccard index.
    2. Its conformal p-value is ``(1 + #{calibration losses >= loss}) / (1 + #calibration)``: for an honest teammate no
       less than uniform, if calibration and frame come from the same world. With n calibration losses no p-value is
       below ``1 / (n + 1)``, so fewer than ``S / rate`` of them can accuse nobody alone.
    3. Benjamini and Hochberg (1995): with the p-values ascending, the first k teammates are accused, for the largest k
       with ``p_(k) <= k rate / S``. The expected share of honest ones among the accused is at most the rate.
    4. All others are fused and tested; if that fails, the answer is the best of them that is in consensus alone.

    The published method adds a second statistic, the loss of a learned reconstruction of the feature map, and uses what
    is left without a further test. Teammates without evidence are neither accused nor fused.
    """

    kind: Literal["conformal"] = "conformal"
    false_discovery_rate: float = Field(
        DEFAULT_RATE, gt=0, lt=1, description="Expected share of honest teammates among the accused, at most."
    )
    calibration: Annotated[tuple[Annotated[float, Field(ge=0, le=1)], ...], Field(fail_fast=True)] | None = Field(
        None,
        min_length=1,
        max_length=2000,
        description="Jaccard indices of honest single teammates; by default those of the shipped detector.",
    )

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 to 4."""
        outcomes = yield from one_each(team, rng)
        judged = [(i, o) for i, o in enumerate(outcomes) if o.verdict is not Verdict.NO_EVIDENCE]
        p_values = self.p_values(np.array([o.jaccard_index for _, o in judged]))
        guilty = discoveries(p_values, self.false_discovery_rate)
        accused = {
            o.teammates[0]: Rejection(
                Reason.DISSENSUS,
                {"hypotheses": [i], "lowest_jaccard_index": o.jaccard_index, "p_value": float(p)},
            )
            for (i, o), p, bad in zip(judged, p_values, guilty, strict=True)
            if bad
        }
        passed = [o.teammates[0] for _, o in judged if o.teammates[0] not in accused]
        accepted = yield from unite(team, passed, outcomes)
        return conclude(team, accepted, outcomes, state, accused=accused)

    def p_values(self, jaccard_indices: FloatArray) -> FloatArray:
        """Conformal p-values (n,) of single teammates with these Jaccard indices (n,)."""
        known = np.sort(self.calibration if self.calibration is not None else SINGLE_TEAMMATE)
        as_bad = np.searchsorted(known, jaccard_indices, side="right")
        return (1.0 + as_bad) / (1.0 + len(known))


def discoveries(p_values: FloatArray, rate: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """The hypotheses that Benjamini and Hochberg's procedure rejects at a false discovery rate, a mask (n,)."""
    n = len(p_values)
    ascending = np.sort(p_values)
    below = np.flatnonzero(ascending <= rate * np.arange(1, n + 1) / max(n, 1))
    threshold = ascending[below[-1]] if len(below) else -1.0
    return np.asarray(p_values <= threshold)
