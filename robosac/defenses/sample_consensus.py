"""ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the ego."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import comb
from typing import ClassVar

import numpy as np

from robosac.budget import (
    DEFAULT_CONFIDENCE,
    DomainError,
    attackers_in_team,
    exact_budget,
    exact_collaborators,
)
from robosac.consensus import DEFAULT_THRESHOLD, Verdict
from robosac.defenses.protocol import (
    Conversation,
    Decision,
    Hypothesis,
    Outcome,
    Source,
    State,
    explain_rejections,
)

DEFAULT_BUDGET = 7


@dataclass(frozen=True)
class SampleConsensus:
    """Algorithm 1 of *Among Us* (ICCV 2023), attacker ratio known.

    1. The runner decodes the ego's own perception as the reference.
    2. Draw s teammates at random; the runner fuses them with the ego and compares.
    3. In consensus, that fusion is the answer. Otherwise draw again, until N hypotheses are tested.
    4. With none in consensus, the answer is the ego's own perception.

    The paper's listing falls back one step early; here N hypotheses are tested before the fallback. A verdict of *no
    evidence* spends a step and settles nothing.

    Parameters
    ----------
    attacker_ratio : float
        eta, strictly between 0 and 1.
    sampling_budget : int, optional
        N, at least 1. If only ``collaborators`` is given, N follows from the exact law; if neither is, N is 7.
    collaborators : int, optional
        s, at least 1. If absent, the most that the budget guarantees by the exact law (at least 1).
    confidence : float
        p, the chance that N hypotheses hold an attacker-free one.
    consensus_threshold : float
        Jaccard index from which on two perceptions agree.
    distinct : bool, default True
        Never test the same subset twice in a frame: the test would only repeat its answer. False draws
        independently, as the paper does.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """

    kind: ClassVar[str] = "sample_consensus"

    attacker_ratio: float = 0.2
    sampling_budget: int | None = None
    collaborators: int | None = None
    confidence: float = DEFAULT_CONFIDENCE
    consensus_threshold: float = DEFAULT_THRESHOLD
    distinct: bool = True

    def __post_init__(self) -> None:
        for name in ("attacker_ratio", "confidence"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise DomainError(f"{name} must lie strictly between 0 and 1, got {getattr(self, name)}")
        if not 0.0 < self.consensus_threshold <= 1.0:
            raise DomainError(f"consensus_threshold must be in (0, 1], got {self.consensus_threshold}")
        for name in ("sampling_budget", "collaborators"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise DomainError(f"{name} must be at least 1, got {value}")

    def initial_state(self) -> State:
        """Nothing is remembered between frames."""
        return {}

    def check_team(self, team_size: int) -> None:
        """Raise `DomainError` if more collaborators are asked for than the full team has benign teammates."""
        if self.collaborators is not None and team_size > 0:
            exact_budget(
                team_size, attackers_in_team(team_size, self.attacker_ratio), self.collaborators, self.confidence
            )

    def plan(self, team_size: int) -> tuple[int, int]:
        """Collaborators s and budget N for the teammates present in a frame.

        With teammates missing, s shrinks with the team; it never falls below 1, since a hypothesis is verified whatever
        the assumed ratio says.
        """
        attackers = attackers_in_team(team_size, self.attacker_ratio)
        most = max(1, team_size - attackers)
        if self.collaborators is not None:
            s = min(self.collaborators, most)
        else:
            budget = self.sampling_budget or DEFAULT_BUDGET
            s = max(1, exact_collaborators(team_size, attackers, budget, self.confidence, distinct=self.distinct))
        if self.sampling_budget is not None or self.collaborators is None:
            n = self.sampling_budget or DEFAULT_BUDGET
        else:
            n = exact_budget(team_size, min(attackers, team_size - s), s, self.confidence, distinct=self.distinct)
        return s, min(n, comb(team_size, s)) if self.distinct else n

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 2 to 4, one hypothesis a batch."""
        outcomes: list[Outcome] = []
        accepted: Hypothesis = ()
        if team:
            s, n = self.plan(len(team))
            for subset in _draws(team, s, n, self.distinct, rng):
                tested = yield [subset]
                if not tested:
                    break
                outcomes.extend(tested)
                if tested[0].verdict is Verdict.CONSENSUS:
                    accepted = subset
                    break
        return Decision(
            accepted=accepted,
            source=Source.CONSENSUS if accepted else Source.EGO_ONLY,
            rejected=explain_rejections(team, accepted, outcomes),
            attacker_ratio=self.attacker_ratio,
            state=state,
        )


def _draws(team: Sequence[str], s: int, n: int, distinct: bool, rng: np.random.Generator) -> Iterator[Hypothesis]:
    """``n`` random subsets of size ``s``, in team order; distinct ones by rejection, so that large teams cost no
    memory.
    """
    seen: set[Hypothesis] = set()
    drawn = 0
    while drawn < n:
        subset = tuple(team[i] for i in np.sort(rng.choice(len(team), s, replace=False)))
        if distinct and subset in seen:
            continue
        seen.add(subset)
        drawn += 1
        yield subset
