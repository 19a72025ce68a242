"""Which subsets are worth considering. Subsets are rows (n, S) of booleans over the members."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing.choice import HARM, LIKELY_HONEST, gain
from robosac.defenses.group_testing.posterior import EXACT, Posterior

SUSPECTS_AT_ONCE = 4
"""Most unresolved teammates in a test of a larger team."""
GROUPS = 60
"""Groups of unresolved teammates considered in a larger team."""
UNRESOLVED = (0.02, 0.995)
"""A teammate with a suspicion between these is unresolved."""
ANSWERS = 4
"""Answers considered in a larger team."""
WITNESSES = 4
"""Trusted teammates that unresolved ones are added to in a larger team."""
MOST_WITNESSES = 6
"""Largest subset decoded already that unresolved teammates are added to in a larger team."""
WORTH_WITNESSES = 0.1
"""Bits that some group must be in doubt for answers to be kept small enough to be witnesses."""
_CERTAIN = 1e-12
_DIGITS = 9


def candidates(posterior: Posterior, present: BoolArray, decoded: BoolArray) -> BoolArray:
    """Subsets worth considering, without those decoded.

    In a small team these are all. In a larger one they are the best answers, and groups of up to four unresolved
    teammates of one block, alone or beside trusted ones.

    Parameters
    ----------
    posterior : Posterior
    present : (S,) bool ndarray
    decoded : (m, S) bool ndarray
    """
    here = np.flatnonzero(present)
    if len(here) <= EXACT:
        found = _all_of(tuple(here.tolist()), len(present))
        left = np.ones(1 + len(found), dtype=bool)
        left[decoded[:, here] @ (1 << np.arange(len(here)))] = False
        return found[left[1:]]
    found = _some_of(posterior, here, decoded)
    unique = {row.tobytes(): index for index, row in reversed(list(enumerate(np.packbits(found, axis=1))))}
    for row in np.packbits(decoded, axis=1):
        unique.pop(row.tobytes(), None)
    return found[sorted(unique.values())]


def unresolved(suspicion: FloatArray) -> BoolArray:
    """Who (S,) is neither as good as cleared nor as good as named."""
    low, high = UNRESOLVED
    return (suspicion >= low) & (suspicion <= high)


def cleared(suspicion: FloatArray) -> BoolArray:
    """Who (S,) is as good as cleared."""
    return suspicion < UNRESOLVED[0]


@lru_cache(maxsize=64)
def _all_of(members: tuple[int, ...], size: int) -> BoolArray:
    """All subsets but the empty one of these members, (2 ** m - 1, size), by their bits; nobody may write to them."""
    codes = np.arange(1, 1 << len(members))
    rows = np.zeros((len(codes), size), dtype=bool)
    rows[:, members] = (codes[:, None] >> np.arange(len(members))) & 1
    rows.flags.writeable = False
    return rows


def _some_of(posterior: Posterior, here: IntArray, decoded: BoolArray) -> BoolArray:
    """Answers, and groups of unresolved teammates beside each subset of cleared ones decoded before: so a test is
    evidence twice, by the pairs with the ego and with that subset. Where there is none yet, groups beside nobody and
    beside the least suspected. While somebody is in doubt, an answer holds no more than can be witnesses afterwards, or
    all who are cleared, or more likely honest than not.
    """
    suspicion = posterior.marginals()
    good = cleared(suspicion)
    ranked = here[least_first(suspicion[here])]
    doubtful = np.zeros(len(suspicion), dtype=bool)
    doubtful[here] = unresolved(suspicion)[here]
    groups, doubt = _groups(posterior, doubtful)
    counts = _answer_sizes(suspicion[ranked[:WITNESSES] if doubt >= WORTH_WITNESSES else ranked])
    large = {int(good[here].sum()), int((suspicion[here] < LIKELY_HONEST).sum())} - {0}
    counts = np.union1d(counts, sorted(large)).astype(np.int64)
    answers = np.zeros((len(counts), len(suspicion)), dtype=bool)
    for row, count in zip(answers, counts, strict=True):
        row[ranked[:count]] = True
    bases = decoded[(decoded.sum(axis=1) <= MOST_WITNESSES) & ~decoded[:, ~good].any(axis=1)]
    if not len(bases):
        bases = np.zeros((2, len(suspicion)), dtype=bool)
        bases[1, ranked[good[ranked]][:WITNESSES]] = True
    return np.concatenate([answers, (bases[:, None] | groups[None]).reshape(-1, len(suspicion))])


def _groups(posterior: Posterior, doubtful: BoolArray) -> tuple[BoolArray, float]:
    """The groups (n, S) of doubtful teammates within blocks of which it is least certain whether anybody attacks, and
    the greatest of their entropies, bits.
    """
    suspects = posterior.masks(doubtful[None])[:, 0].tolist()
    within = [(b, _small_groups(mask)) for b, mask in enumerate(suspects) if mask]
    if not within:
        return np.zeros((0, len(doubtful)), dtype=bool), 0.0
    clean = [posterior.clean_within(b)[masks] for b, masks in within]
    p = np.clip(np.concatenate(clean), _CERTAIN, 1 - _CERTAIN)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    best = least_first(-entropy)[:GROUPS]
    blocks = np.repeat([b for b, _ in within], [len(masks) for _, masks in within])
    rows = posterior.rows(blocks[best], np.concatenate([masks for _, masks in within])[best])
    return rows, float(entropy.max())


@lru_cache(maxsize=256)
def _small_groups(suspects: int) -> IntArray:
    """Masks of the groups of up to `SUSPECTS_AT_ONCE` of the suspects in a mask."""
    masks = np.arange(1, suspects + 1)
    few = np.array([mask.bit_count() <= SUSPECTS_AT_ONCE for mask in masks.tolist()], dtype=bool)
    groups: IntArray = masks[few & (masks & ~suspects == 0)]
    return groups


def least_first(values: FloatArray) -> IntArray:
    """Places of the values (n,), the least first; what differs by rounding only stays in order."""
    return np.argsort(values.round(_DIGITS), kind="stable")


def _answer_sizes(ascending: FloatArray) -> IntArray:
    """How many of the least suspected make the best answers, as if teammates were independent."""
    clean = np.cumprod(1.0 - ascending)
    worth = clean * gain(np.arange(1, len(clean) + 1)) - (1.0 - clean) * HARM
    return least_first(-worth)[:ANSWERS] + 1
