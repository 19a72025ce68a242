"""ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the ego."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from robosac.answers import Source
from robosac.defenses.protocol import Conversation, Decision, Hypothesis, Outcome, State, explain_rejections
from robosac.defenses.sampling import Sampling, SamplingSettings, search


@dataclass(frozen=True)
class SampleConsensus(Sampling):
    """Algorithm 1 of *Among Us* (ICCV 2023), attacker ratio known; the paper's dynamic team.

    1. The reference is the ego's own perception (or, for temporal consistency, the previous answer).
    2. Draw s teammates at random; the runner fuses them with the ego and compares.
    3. In consensus, that fusion is the answer. Otherwise draw again, until N hypotheses are tested.
    4. With none in consensus, the answer is the ego's own perception.

    The paper's listing falls back one step early; here N hypotheses are tested before the fallback. A verdict of *no
    evidence* spends a step and settles nothing. The settings are those of `SamplingSettings`.
    """

    kind: ClassVar[str] = "sample_consensus"

    def initial_state(self, team: Sequence[str]) -> State:  # noqa: ARG002
        """Nothing is remembered between frames."""
        return {}

    def change_team(self, state: State, team: Sequence[str]) -> State:  # noqa: ARG002
        """Nothing is remembered between frames."""
        return state

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 2 to 4, one hypothesis a batch."""
        outcomes: list[Outcome] = []
        accepted: Hypothesis = ()
        if team:
            accepted = yield from search(team, *self.plan(len(team)), self.distinct, rng, outcomes)
        return Decision(
            accepted=accepted,
            source=Source.CONSENSUS if accepted else Source.EGO_ONLY,
            rejected=explain_rejections(team, accepted, outcomes),
            attacker_ratio=self.attacker_ratio,
            state=state,
        )


class SampleConsensusSettings(SamplingSettings):
    """ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the reference."""

    makes = SampleConsensus
    kind: Literal["sample_consensus"] = "sample_consensus"
