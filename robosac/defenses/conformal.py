"""Conformal tests of single teammates with control of false discoveries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from robosac.answers import Reason, Verdict
from robosac.boxes import FloatArray
from robosac.budget import DomainError
from robosac.defenses.benign_scores import SINGLE_TEAMMATE
from robosac.defenses.memoryless import Memoryless, decide, unite
from robosac.defenses.protocol import Conversation, Hypothesis, Outcome, Rejection, State
from robosac.defenses.settings import ConsensusSettings

DEFAULT_RATE = 0.05


@dataclass(frozen=True)
class Conformal(Memoryless):
    """The idea of MADE (IROS 2024): calibrated tests of each teammate, and a bound on honest ones accused.

    1. Each teammate is fused alone with the ego. Its match loss is one minus the Jaccard index.
    2. Its conformal p-value is ``(1 + #{calibration losses >= loss}) / (1 + #calibration)``: for an honest teammate no
       less than uniform, if calibration and frame come from the same world.
    3. Benjamini and Hochberg (1995): with the p-values ascending, the first k teammates are accused, for the largest k
       with ``p_(k) <= k rate / S``. The expected share of honest ones among the accused is at most the rate.
    4. All others are fused and tested; if that fails, the answer is the best of them that is in consensus alone.

    The published method adds a second statistic, the loss of a learned reconstruction of the feature map, and uses what
    is left without a further test. Teammates without evidence are neither accused nor fused.

    Parameters
    ----------
    consensus_threshold : float
        Jaccard index from which on two perceptions agree; for the test of the answer.
    reference : Reference
        What hypotheses are compared with.
    false_discovery_rate : float
        Strictly between 0 and 1.
    calibration : tuple of float, optional
        Jaccard indices in [0, 1] of honest single teammates. By default those of the shipped detector on validation
        scenes. With n of them no p-value is below ``1 / (n + 1)``, so fewer than ``S / rate`` can accuse nobody
        alone.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """

    kind: ClassVar[str] = "conformal"

    false_discovery_rate: float = DEFAULT_RATE
    calibration: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.false_discovery_rate < 1.0:
            raise DomainError(
                f"false_discovery_rate must lie strictly between 0 and 1, got {self.false_discovery_rate}"
            )
        if self.calibration is not None and not (
            self.calibration and all(0.0 <= index <= 1.0 for index in self.calibration)
        ):
            raise DomainError("calibration must hold Jaccard indices in [0, 1]")

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 to 4; the random order is that in which a deadline cuts."""
        outcomes: list[Outcome] = []
        singles: list[Hypothesis] = [(team[i],) for i in rng.permutation(len(team))]
        if singles:
            outcomes.extend((yield singles))
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
        return decide(team, accepted, outcomes, state, accused)

    def p_values(self, jaccard_indices: FloatArray) -> FloatArray:
        """Conformal p-values (n,) of single teammates with these Jaccard indices (n,)."""
        known = np.sort(self.calibration if self.calibration is not None else SINGLE_TEAMMATE)
        as_bad = np.searchsorted(known, jaccard_indices, side="right")
        p: FloatArray = (1.0 + as_bad) / (1.0 + len(known))
        return p


class ConformalSettings(ConsensusSettings):
    """Calibrated tests of every teammate with control of false discoveries."""

    makes = Conformal
    kind: Literal["conformal"]
    false_discovery_rate: float = Field(
        DEFAULT_RATE, gt=0, lt=1, description="Expected share of honest teammates among the accused, at most."
    )
    calibration: tuple[Annotated[float, Field(ge=0, le=1)], ...] | None = Field(
        None,
        min_length=1,
        max_length=10_000,
        description="Jaccard indices of honest single teammates; by default those of the shipped detector.",
    )


def discoveries(p_values: FloatArray, rate: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """The hypotheses that Benjamini and Hochberg's procedure rejects at a false discovery rate, a mask (n,)."""
    n = len(p_values)
    ascending = np.sort(p_values)
    below = np.flatnonzero(ascending <= rate * np.arange(1, n + 1) / max(n, 1))
    threshold = ascending[below[-1]] if len(below) else -1.0
    return np.asarray(p_values <= threshold)
