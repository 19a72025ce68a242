"""What defences share that test groups of teammates in every frame anew."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from robosac.answers import Verdict
from robosac.defenses.protocol import Asking, Hypothesis, Outcome, State
from robosac.defenses.settings import ConsensusSettings


class Memoryless(ConsensusSettings):
    """A defence that remembers nothing between frames, and that any team will do for."""

    def initial_state(self, team: Sequence[str]) -> State:  # noqa: ARG002
        return {}

    def change_team(self, state: State, team: Sequence[str]) -> State:  # noqa: ARG002
        return state

    def check_team(self, team_size: int) -> None: ...


def one_each(team: Sequence[str], rng: np.random.Generator) -> Asking[list[Outcome]]:
    """Test each teammate alone, in random order: that in which a deadline cuts."""
    singles: list[Hypothesis] = [(team[i],) for i in rng.permutation(len(team))]
    return list((yield singles)) if singles else []


def unite(team: Sequence[str], passed: Collection[str], outcomes: list[Outcome]) -> Asking[Hypothesis]:
    """Fuse all that passed their tests, and verify that fusion too.

    Several groups, each in consensus, need not be in consensus together. If they are not, or the time is up, the answer
    is the largest hypothesis in consensus among them (of several the one with the highest Jaccard index).

    Parameters
    ----------
    team : sequence of str
    passed : collection of str
    outcomes : list of Outcome
        Of this frame; the last test is appended.

    Returns
    -------
    tuple of str
        Verified in this frame; empty if nothing was.
    """
    together = tuple(name for name in team if name in passed)
    if together and all(outcome.teammates != together for outcome in outcomes):
        outcomes.extend((yield [together]))
    verified = [o for o in outcomes if o.verdict is Verdict.CONSENSUS and set(o.teammates) <= set(together)]
    best = max(verified, key=lambda o: (len(o.teammates), o.jaccard_index), default=None)
    return best.teammates if best is not None else ()
