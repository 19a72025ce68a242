"""A world of boxes in which attackers shift what they touch, and likelihoods made for it."""

from collections.abc import Collection

import numpy as np

from robosac.answers import Verdict
from robosac.defenses import Outcome
from robosac.defenses.group_testing import OPEN, EvidenceModel
from robosac.defenses.group_testing.model import (
    BINS,
    CELLS,
    CHANGE_BINS,
    CHANGE_SIZES,
    CLEAN,
    CROWD_BINS,
    LOSS_BINS,
    NOVELTY_BINS,
    SIZES,
)

TEAM = ("car-2", "car-3", "car-4", "car-5", "rsu")
SEEN = np.array([[10.0 * i, 5.0, 4.0, 2.0, 0.0, 0.9] for i in range(8)])


def shifted(subset: tuple[str, ...], frame: int = 0) -> np.ndarray:
    """Every box moved by .7 to 1.9 m, for each subset somewhere else, and from frame to frame to another side."""
    angle = sum(map(ord, "".join(subset)))
    return SEEN + [1.3 * np.cos(angle), 1.3 * np.sin(angle) + 0.6 * (-1) ** frame, 0, 0, 0, 0]


def make_model(kinds=("pgd", "erase", OPEN)) -> EvidenceModel:
    """Unattacked outcomes low in loss, attacked ones the other way round; beside the ego alone, attacks of the kind
    ``erase`` show nothing. Whose view is complementary makes no difference. Unattacked boxes come and go less.
    """
    loss = np.repeat(np.linspace(-2, 2, LOSS_BINS), NOVELTY_BINS)
    pairs = np.empty((CLEAN + CELLS * len(kinds), len(SIZES), BINS))
    pairs[:CLEAN] = np.exp(-loss)
    for row, kind in zip(range(CLEAN, len(pairs), CELLS), kinds, strict=True):
        pairs[row : row + CELLS] = np.ones(BINS) if kind == OPEN else np.exp(loss)
        if kind == "erase":
            pairs[row : row + CELLS, [a == 0 for a, _ in SIZES]] = np.exp(-loss)
    changes = np.ones((1 + len(kinds), CHANGE_SIZES, CROWD_BINS, CHANGE_BINS))
    changes[0] = np.exp(-np.linspace(-3, 3, CHANGE_BINS))
    return EvidenceModel(0.0, tuple(kinds), normal(pairs), normal(changes))


def normal(table: np.ndarray) -> np.ndarray:
    """So that each last axis sums to 1."""
    return table / table.sum(axis=-1, keepdims=True)


def outcome(subset: tuple[str, ...], attackers: Collection[str], frame: int = 0, *, reference=SEEN) -> Outcome:
    """What a detector would show: attackers move every box, and agree little with the ego, which stands still."""
    dirty = not set(attackers).isdisjoint(subset)
    index, verdict = (0.12, Verdict.DISSENSUS) if dirty else (0.93, Verdict.CONSENSUS)
    if not len(reference):
        index, verdict = (0.0, Verdict.DISSENSUS)
    boxes = shifted(subset, frame) if dirty else SEEN
    return Outcome(subset, index, verdict, boxes, reference, np.eye(4), frame, alone=reference)


def run_frame(defense, state, team, attackers, rng, most=100, judge=outcome):
    """One frame; after ``most`` outcomes the time is up. The decision and what was tested.

    ``judge`` gives the outcome of a subset, by the attackers and the frame's number in the session.
    """
    conversation = defense.converse(team, state, rng)
    frame = state["memory"]["frame"]
    tested = []
    try:
        batch = next(conversation)
        while True:
            outcomes = [judge(subset, attackers, frame) for subset in batch] if len(tested) < most else []
            tested += outcomes
            batch = conversation.send(outcomes)
    except StopIteration as stop:
        return stop.value, tested
