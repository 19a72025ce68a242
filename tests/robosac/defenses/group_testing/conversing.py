"""A world of boxes in which attackers shift what they touch, and likelihoods made for it."""

from collections.abc import Collection

import numpy as np

from robosac.consensus import Verdict
from robosac.defenses import Outcome
from robosac.defenses.group_testing import OPEN, EvidenceModel
from robosac.defenses.group_testing.model import (
    CELLS,
    JACCARD_BINS,
    JOINING_SIZES,
    LOSS_BINS,
    NOVELTY_BINS,
    SIZES,
    WITNESS_SIZES,
)

TEAM = ("car-2", "car-3", "car-4", "car-5", "rsu")
SEEN = np.array([[10.0 * i, 5.0, 4.0, 2.0, 0.0, 0.9] for i in range(8)])


def shifted(subset: tuple[str, ...]) -> np.ndarray:
    """Every box moved by 1.3 m, for each subset somewhere else."""
    angle = sum(map(ord, "".join(subset)))
    return SEEN + [1.3 * np.cos(angle), 1.3 * np.sin(angle), 0, 0, 0, 0]


def make_model(kinds=("pgd", "erase", OPEN)) -> EvidenceModel:
    """Unattacked outcomes low in loss and high in index; attacked ones the other way round, but for the index of the
    kind ``erase``, which says nothing.
    """
    k = len(kinds)
    index = np.linspace(-2, 2, JACCARD_BINS)
    by_kind = {"pgd": np.exp(-index), "erase": np.exp(index), OPEN: np.ones(JACCARD_BINS)}
    jaccard = np.stack([np.exp(index), *[by_kind[kind] for kind in kinds]])
    loss = np.repeat(np.linspace(-2, 2, LOSS_BINS), NOVELTY_BINS)
    pairs = np.stack([np.exp(-loss), *[np.exp(loss)] * (CELLS * (k - 1)), *[np.ones(len(loss))] * CELLS])
    jaccard = np.repeat(jaccard[:, None], SIZES, axis=1)
    pairs = np.tile(pairs[:, None, None], (1, WITNESS_SIZES, JOINING_SIZES, 1))
    jaccard /= jaccard.sum(axis=-1, keepdims=True)
    pairs /= pairs.sum(axis=-1, keepdims=True)
    return EvidenceModel(0.0, tuple(kinds), jaccard, pairs)


def outcome(subset: tuple[str, ...], attackers: Collection[str], *, reference=SEEN) -> Outcome:
    """What a detector would show: attackers move every box, and agree little with the ego."""
    dirty = not set(attackers).isdisjoint(subset)
    index, verdict = (0.12, Verdict.DISSENSUS) if dirty else (0.93, Verdict.CONSENSUS)
    if not len(reference):
        index, verdict = (0.0, Verdict.DISSENSUS)
    return Outcome(subset, index, verdict, shifted(subset) if dirty else SEEN, reference)


def run_frame(defense, state, team, attackers, rng, most=100, judge=outcome):
    """One frame; after ``most`` outcomes the time is up. The decision and what was tested."""
    conversation = defense.converse(team, state, rng)
    tested = []
    try:
        batch = next(conversation)
        while True:
            outcomes = [judge(subset, attackers) for subset in batch] if len(tested) < most else []
            tested += outcomes
            batch = conversation.send(outcomes)
    except StopIteration as stop:
        return stop.value, tested
