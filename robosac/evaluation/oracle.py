"""Defences against a verdict that is never wrong: what sampling costs, apart from any detector."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from robosac.answers import Verdict
from robosac.defenses import Decision, Defense, Hypothesis, Outcome, State


def oracle_outcome(subset: Hypothesis, attackers: Collection[str]) -> Outcome:
    """The verdict of a perfect test: consensus exactly if no attacker is in the subset."""
    clean = not any(member in attackers for member in subset)
    return Outcome(subset, 1.0 if clean else 0.0, Verdict.CONSENSUS if clean else Verdict.DISSENSUS)


def converse_with_oracle(
    defense: Defense, team: Sequence[str], attackers: Collection[str], state: State, rng: np.random.Generator
) -> tuple[Decision, list[Outcome]]:
    """One frame's conversation with perfect verdicts: the decision and everything that was tested."""
    outcomes: list[Outcome] = []
    conversation = defense.converse(team, state, rng)
    try:
        batch = next(conversation)
        while True:
            tested = [oracle_outcome(subset, attackers) for subset in batch]
            outcomes.extend(tested)
            batch = conversation.send(tested)
    except StopIteration as stop:
        decision: Decision = stop.value
    return decision, outcomes


def simulate_sampling(
    defense: Defense, team_size: int, attackers: int, runs: int, rng: np.random.Generator
) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Hypotheses tested in each of many independent frames, (runs,), for a given number of attackers in the team."""
    team = [f"v{i}" for i in range(team_size)]
    bad = set(team[:attackers])
    state = defense.initial_state(team)
    steps = [len(converse_with_oracle(defense, team, bad, state, rng)[1]) for _ in range(runs)]
    return np.array(steps, dtype=np.int64)
