"""Algorithm 1 of the paper as a part of several defences: draw subsets of teammates until one is in consensus."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from math import comb
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, PrivateAttr

from robosac.answers import Verdict
from robosac.budget import (
    DEFAULT_CONFIDENCE,
    DomainError,
    attackers_in_team,
    exact_budget,
    exact_collaborators,
)
from robosac.defenses.batch import Batch
from robosac.defenses.memoryless import Memoryless
from robosac.defenses.protocol import Asking, Hypothesis, Outcome

DEFAULT_BUDGET = 7
MAX_BUDGET = 10_000
"""No frame has time for more hypotheses."""
Budget = Annotated[int, Field(ge=1, le=MAX_BUDGET, description="Most hypotheses tested in a frame.")]
Confidence = Annotated[float, Field(gt=0, lt=1, description="That some hypothesis within the budget has no attacker.")]


class Sampling(Memoryless):
    """What is common to the defences that sample with a known attacker ratio.

    If only ``collaborators`` is given, the budget follows from the exact law (`robosac.budget`). If only the budget is
    given, it guarantees so many collaborators by that law, but at least 1. If neither is, the budget is 7.
    """

    budgets: ClassVar[tuple[str, ...]] = ("sampling_budget",)
    attacker_ratio: float = Field(0.2, gt=0, lt=1, description="Assumed share of attackers among the teammates.")
    sampling_budget: Budget | None = None
    collaborators: int | None = Field(None, ge=1, le=1024, description="Teammates in a hypothesis.")
    confidence: Confidence = DEFAULT_CONFIDENCE

    _distinct: bool = PrivateAttr(default=True)

    @classmethod
    def independent(cls, **settings: Any) -> Self:
        """With independent draws, as in the paper: a subset may be tested twice in a frame."""
        defense = cls(**settings)
        defense._distinct = False
        return defense

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
            s = max(1, exact_collaborators(team_size, attackers, n, self.confidence, distinct=self._distinct))
        else:
            s = min(self.collaborators, most)
            if self.sampling_budget is None:
                attackers = min(attackers, team_size - s)
                needed = exact_budget(team_size, attackers, s, self.confidence, distinct=self._distinct)
                n = min(needed, MAX_BUDGET)
        return s, min(n, comb(team_size, s)) if self._distinct else n

    def search(
        self, team: Sequence[str], rng: np.random.Generator, outcomes: list[Outcome], spent: int = 0
    ) -> Asking[Hypothesis]:
        """Algorithm 1 by `plan`, of whose budget so many tests are spent already; see `search`."""
        if not team:
            return ()
        s, n = self.plan(len(team))
        return (yield from search(team, (s, n - spent), rng, outcomes, distinct=self._distinct))


def search(
    team: Sequence[str],
    plan: tuple[int, int],
    rng: np.random.Generator,
    outcomes: list[Outcome],
    *,
    distinct: bool = True,
) -> Asking[Hypothesis]:
    """Test random subsets one by one until one is in consensus, the budget is spent, or the time is up.

    Parameters
    ----------
    team : sequence of str
        Teammates present.
    plan : (int, int)
        Collaborators in a hypothesis, at most as many as the team has; hypotheses at most.
    rng : numpy.random.Generator
    outcomes : list of Outcome
        Everything tested is appended.
    distinct : bool
        Whether no subset may come twice; then there must be as many subsets as hypotheses.

    Returns
    -------
    tuple of str
        The subset in consensus; empty if there is none.
    """
    draws = _Draws(team, plan, rng, distinct)
    while draws.left > 0:
        subset = draws.draw()
        tested = yield Batch([subset], draws.coming)
        outcomes.extend(tested)
        if not tested:
            break
        if tested[0].verdict is Verdict.CONSENSUS:
            return subset
    return ()


class _Draws:
    """Random subsets by a plan as `search` takes it.

    Those that are coming may be looked at. They are drawn then, but the generator stands where it stood.
    """

    def __init__(self, team: Sequence[str], plan: tuple[int, int], rng: np.random.Generator, distinct: bool) -> None:
        self._team, self._rng = team, rng
        self._s, self.left = plan
        self._seen = set[Hypothesis]() if distinct else None
        self._ahead = deque[tuple[Hypothesis, Mapping[str, Any]]]()  # with the generator's state after each

    def draw(self) -> Hypothesis:
        """The next one."""
        if not self._ahead:
            self._look()
        subset, self._rng.bit_generator.state = self._ahead.popleft()
        self.left -= 1
        return subset

    def coming(self) -> Iterator[Hypothesis]:
        """What will be drawn from now on."""
        for i in range(self.left):
            while i >= len(self._ahead):
                self._look()
            yield self._ahead[i][0]

    def _look(self) -> None:
        bits = self._rng.bit_generator
        now = bits.state
        if self._ahead:
            bits.state = self._ahead[-1][1]
        subset = draw(self._team, self._s, self._rng)
        if self._seen is not None:
            while subset in self._seen:  # so that large teams cost no memory
                subset = draw(self._team, self._s, self._rng)
            self._seen.add(subset)
        self._ahead.append((subset, bits.state))
        bits.state = now


def draw(team: Sequence[str], s: int, rng: np.random.Generator) -> Hypothesis:
    """A random subset of size ``s``, in team order."""
    return tuple(team[i] for i in sorted(rng.choice(len(team), s, replace=False).tolist()))
