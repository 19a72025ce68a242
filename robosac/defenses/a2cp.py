"""A2CP with retrospect, Algorithm 2: estimate the attacker ratio while answering."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import partial
from itertools import islice
from math import comb
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from robosac.answers import Verdict
from robosac.budget import DEFAULT_CONFIDENCE, DomainError, eq2_budget
from robosac.defenses.batch import Batch
from robosac.defenses.protocol import Asking, Conversation, Hypothesis, Outcome, State, conclude
from robosac.defenses.sampling import Budget, Confidence, draw, search
from robosac.defenses.settings import ConsensusSettings

DEFAULT_BUDGET = 5


class A2CP(ConsensusSettings):
    """Aggressive-to-conservative probing: estimate the attacker ratio while answering.

    Algorithm 2 of *Among Us* (ICCV 2023), with retrospect and errata. For ascending ratios R_k of a team of S, ``U_k``
    (Eq. 2 at eta = R_k, s = S (1 - R_k)) bounds the attempts and ``T_k`` counts the failed ones.

    1. A frame visits k = 1..K as long as its budget N lasts and some ``T_k < U_k``, and tests one hypothesis of
       S (1 - R_k) teammates for each k with ``T_k < U_k``.
    2. At a dissensus T_k grows by one. At a consensus the estimate becomes R_k, and k and all higher ratios are
       settled; lower ratios go on being tried, in this and in later frames, until their U is spent (the retrospect).
    3. The frame's answer is its largest hypothesis in consensus, else the ego's own perception.
    4. Once all is settled, frames go on as Algorithm 1 at the estimated ratio.

    Errata: U_1 is 1 at R_1 = 0, where Eq. 2 gives 0 (one dissensus with everybody proves that there is an attacker); N
    is a hard limit, which the listing's inner loop overruns; and the listing keeps no answer for the frame. A verdict
    of no evidence spends a step and moves no counter. In a frame with teammates missing nothing is counted, since the
    bounds hold for the full team.
    """

    kind: Literal["a2cp"] = "a2cp"
    ratios: Annotated[tuple[float, ...], Field(fail_fast=True)] | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="Ascending in [0, 1), multiples of 1 / S; by default all that the team size allows.",
    )
    budgets: ClassVar[tuple[str, ...]] = ("sampling_budget",)
    sampling_budget: Budget = DEFAULT_BUDGET
    confidence: Confidence = DEFAULT_CONFIDENCE

    def check_team(self, team_size: int) -> None:
        """Raise `DomainError` if the ratios do not ascend or one means no whole number of attackers in such a team."""
        self._benign(team_size)

    def initial_state(self, team: Sequence[str]) -> State:
        """No attempts yet; the estimate starts at 1, everybody an attacker.

        Returns
        -------
        dict
            ``team_size``; ``ratios``, ``bounds`` (U), ``attempts`` (T), lists of one length; ``estimate``.
        """
        benign = self._benign(len(team))
        bounds = [1 if s == len(team) else eq2_budget(s, 1 - s / len(team), self.confidence) for s in benign]
        return {
            "team_size": len(team),
            "ratios": [(len(team) - s) / len(team) for s in benign],
            "bounds": bounds,
            "attempts": [0] * len(bounds),
            "estimate": 1.0,
        }

    def change_team(self, state: State, team: Sequence[str]) -> State:  # noqa: ARG002
        """A new team has a new ratio: the estimate begins again."""
        return self.initial_state(team)

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Probe, or go on at the estimate."""
        outcomes: list[Outcome] = []
        attempts, estimate = state["attempts"], float(state["estimate"])
        complete = len(team) == state["team_size"]
        if not team:
            accepted: Hypothesis = ()
        elif all(t >= u for t, u in zip(attempts, state["bounds"], strict=True)):
            accepted = yield from self._settled(team, estimate, rng, outcomes)
        else:
            probed = yield from self._probe(team, state, rng, outcomes)
            if complete:
                attempts, found = probed
                estimate = estimate if found is None else found
            in_consensus = [o.teammates for o in outcomes if o.verdict is Verdict.CONSENSUS]
            accepted = max(in_consensus, key=len, default=())
        ratio = estimate if complete or estimate < 1.0 else None
        state = {**state, "attempts": list(attempts), "estimate": estimate}
        return conclude(team, accepted, outcomes, state, attacker_ratio=ratio)

    def _probe(
        self, team: Sequence[str], state: State, rng: np.random.Generator, outcomes: list[Outcome]
    ) -> Asking[tuple[list[int], float | None]]:
        """Steps 1 and 2; returns the counters and the estimate, if there is a new one."""
        attempts, bounds = list(state["attempts"]), list(state["bounds"])
        estimate: float | None = None
        visits = _visits(state, attempts, len(team))
        for left in range(self.sampling_budget - 1, -1, -1):
            k, s = next(visits, (None, 0))
            if k is None:
                break
            tested = yield Batch([draw(team, s, rng)], partial(_next_probes, team, state, rng, attempts, k, left))
            if not tested:
                break
            outcomes.extend(tested)
            if tested[0].verdict is Verdict.CONSENSUS:
                estimate = state["ratios"][k]
                attempts[k:] = bounds[k:]
            elif tested[0].verdict is Verdict.DISSENSUS:
                attempts[k] += 1
        return attempts, estimate

    def _settled(
        self, team: Sequence[str], estimate: float, rng: np.random.Generator, outcomes: list[Outcome]
    ) -> Asking[Hypothesis]:
        """Step 4."""
        s = round(len(team) * (1 - estimate))
        if s == 0:
            return ()
        return (yield from search(team, (s, min(self.sampling_budget, comb(len(team), s))), rng, outcomes))

    def _benign(self, team_size: int) -> list[int]:
        """Benign teammates that each ratio means, S (1 - R_k)."""
        if self.ratios is None:
            return list(range(team_size, 0, -1))
        if sorted({r for r in self.ratios if 0.0 <= r < 1.0}) != list(self.ratios):
            raise DomainError(f"ratios must ascend within [0, 1), got {list(self.ratios)}")
        benign = []
        for ratio in self.ratios:
            s = team_size * (1 - ratio)
            if team_size and (abs(s - round(s)) > 1e-6 or round(s) < 1):
                raise DomainError(f"ratio {ratio} does not mean a whole number of attackers in a team of {team_size}")
            benign.append(round(s))
        return benign if team_size else []


def _visits(state: State, attempts: Sequence[int], present: int, first: int = 0) -> Iterator[tuple[int, int]]:
    """Each k to be tried next, and its number of teammates, in rounds as long as one is tried.

    The first round begins with k = ``first``. It is looked at what ``attempts`` holds at each step.
    """
    tried = True
    while tried:
        tried = first > 0
        for k in range(first, len(attempts)):
            s = round(state["team_size"] * (1 - state["ratios"][k]))
            if attempts[k] < state["bounds"][k] and s <= present:
                tried = True
                yield k, s
        first = 0


def _next_probes(
    team: Sequence[str], state: State, rng: np.random.Generator, attempts: Sequence[int], k: int, left: int
) -> Iterator[Hypothesis]:
    """What is probed after k while all are in dissensus."""
    attempts, rng = list(attempts), deepcopy(rng)
    attempts[k] += 1
    for following, s in islice(_visits(state, attempts, len(team), k + 1), left):
        yield draw(team, s, rng)
        attempts[following] += 1
