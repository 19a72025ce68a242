"""Algorithm 1 of the paper as a part of several defences: draw subsets of teammates until one is in consensus."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from pydantic import Field

from robosac.answers import Verdict
from robosac.budget import (
    DEFAULT_CONFIDENCE,
    DomainError,
    attackers_in_team,
    exact_budget,
    exact_collaborators,
)
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.protocol import Hypothesis, Outcome, Reference
from robosac.defenses.settings import ConsensusSettings

DEFAULT_BUDGET = 7
MAX_BUDGET = 10_000
"""No frame has time for more hypotheses."""

Search = Generator[Sequence[Hypothesis], Sequence[Outcome], Hypothesis]
"""Yields hypotheses like a conversation, and returns the one in consensus, or an empty one."""


class SamplingSettings(ConsensusSettings):
    """Settings of every defence that samples with a known attacker ratio; see `Sampling`."""

    attacker_ratio: float = Field(0.2, gt=0, lt=1, description="Assumed share of attackers among the teammates.")
    sampling_budget: int | None = Field(None, ge=1, le=MAX_BUDGET, description="Most hypotheses tested in a frame.")
    collaborators: int | None = Field(None, ge=1, le=1024, description="Teammates in a hypothesis.")
    confidence: float = Field(DEFAULT_CONFIDENCE, gt=0, lt=1)


@dataclass(frozen=True)
class Sampling:
    """What is common to every defence that samples with a known attacker ratio.

    Parameters
    ----------
    attacker_ratio : float
        eta, strictly between 0 and 1.
    sampling_budget : int, optional
        N, from 1 to 10,000. If only ``collaborators`` is given, N follows from the exact law; if neither is, N is 7.
    collaborators : int, optional
        s, at least 1. If absent, the most that the budget guarantees by the exact law (at least 1).
    confidence : float
        p, the chance that N hypotheses hold an attacker-free one.
    consensus_threshold : float
        Jaccard index from which on two perceptions agree.
    distinct : bool, default True
        Never test the same subset twice in a frame: the test would only repeat its answer. False draws
        independently, as the paper does.
    reference : Reference
        What hypotheses are compared with.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """

    attacker_ratio: float = 0.2
    sampling_budget: int | None = None
    collaborators: int | None = None
    confidence: float = DEFAULT_CONFIDENCE
    consensus_threshold: float = DEFAULT_THRESHOLD
    distinct: bool = True
    reference: Reference = Reference.EGO

    def __post_init__(self) -> None:
        for name in ("attacker_ratio", "confidence"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise DomainError(f"{name} must lie strictly between 0 and 1, got {getattr(self, name)}")
        check_threshold(self.consensus_threshold)
        if self.sampling_budget is not None:
            check_budget(self.sampling_budget)
        if self.collaborators is not None and self.collaborators < 1:
            raise DomainError(f"collaborators must be at least 1, got {self.collaborators}")

    def check_team(self, team_size: int) -> None:
        """Raise `DomainError` if more collaborators are asked for than the full team has benign teammates."""
        if self.collaborators is not None and team_size > 0:
            attackers = attackers_in_team(team_size, self.attacker_ratio)
            most = max(1, team_size - attackers)
            if self.collaborators > most:
                raise DomainError(
                    f"of {team_size} teammates with {attackers} attackers at most {most} can be collaborators, "
                    f"{self.collaborators} are asked for"
                )

    def plan(self, team_size: int) -> tuple[int, int]:
        """Collaborators s and budget N for the teammates present in a frame.

        With teammates missing, s shrinks with the team; it never falls below 1, since a hypothesis is verified whatever
        the assumed ratio says.
        """
        attackers = attackers_in_team(team_size, self.attacker_ratio)
        most = max(1, team_size - attackers)
        n = self.sampling_budget or DEFAULT_BUDGET
        if self.collaborators is None:
            s = max(1, exact_collaborators(team_size, attackers, n, self.confidence, distinct=self.distinct))
        else:
            s = min(self.collaborators, most)
            if self.sampling_budget is None:
                attackers = min(attackers, team_size - s)
                needed = exact_budget(team_size, attackers, s, self.confidence, distinct=self.distinct)
                n = min(needed, MAX_BUDGET)
        return s, min(n, comb(team_size, s)) if self.distinct else n


def check_budget(sampling_budget: int) -> None:
    """Raise `DomainError` unless the budget is from 1 to 10,000."""
    if not 1 <= sampling_budget <= MAX_BUDGET:
        raise DomainError(f"sampling_budget must be from 1 to {MAX_BUDGET}, got {sampling_budget}")


def check_threshold(consensus_threshold: float) -> None:
    """Raise `DomainError` unless the threshold is in (0, 1]."""
    if not 0.0 < consensus_threshold <= 1.0:
        raise DomainError(f"consensus_threshold must be in (0, 1], got {consensus_threshold}")


def search(
    team: Sequence[str], s: int, n: int, distinct: bool, rng: np.random.Generator, outcomes: list[Outcome]
) -> Search:
    """Test random subsets one by one until one is in consensus, ``n`` are tested, or the time is up.

    Parameters
    ----------
    team : sequence of str
        Teammates present, at least s.
    s, n : int
        Collaborators in a hypothesis, and hypotheses at most.
    distinct : bool
        Whether no subset may come twice; then n is at most the number of subsets.
    rng : numpy.random.Generator
    outcomes : list of Outcome
        Everything tested is appended.
    """
    for subset in _draws(team, s, n, distinct, rng):
        tested = yield [subset]
        outcomes.extend(tested)
        if not tested:
            break
        if tested[0].verdict is Verdict.CONSENSUS:
            return subset
    return ()


def draw(team: Sequence[str], s: int, rng: np.random.Generator) -> Hypothesis:
    """A random subset of size ``s``, in team order."""
    return tuple(team[i] for i in np.sort(rng.choice(len(team), s, replace=False)))


def _draws(team: Sequence[str], s: int, n: int, distinct: bool, rng: np.random.Generator) -> Iterator[Hypothesis]:
    """``n`` random subsets; distinct ones by rejection, so that large teams cost no memory."""
    seen: set[Hypothesis] = set()
    drawn = 0
    while drawn < n:
        subset = draw(team, s, rng)
        if distinct and subset in seen:
            continue
        seen.add(subset)
        drawn += 1
        yield subset
