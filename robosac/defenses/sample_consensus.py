"""ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the ego."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from robosac.defenses.protocol import Conversation, Outcome, State, conclude
from robosac.defenses.sampling import Sampling


class SampleConsensus(Sampling):
    """ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the reference.

    The algorithm of *Among Us* (ICCV 2023) for a known attacker ratio; the paper's dynamic team.

    1. The reference is the ego's own perception (or, for temporal consistency, the previous answer).
    2. Draw s teammates at random; the runner fuses them with the ego and compares.
    3. In consensus, that fusion is the answer. Otherwise draw again, until N hypotheses are tested.
    4. With none in consensus, the answer is the ego's own perception.

    The paper's listing falls back one step early; here N hypotheses are tested before the fallback. A verdict of *no
    evidence* spends a step and settles nothing.
    """

    kind: Literal["sample_consensus"] = "sample_consensus"

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 2 to 4, one hypothesis a batch."""
        outcomes: list[Outcome] = []
        accepted = yield from self.search(team, rng, outcomes)
        return conclude(team, accepted, outcomes, state, attacker_ratio=self.attacker_ratio)
