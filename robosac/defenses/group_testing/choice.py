"""Which subset to test next, and which to answer with. Subsets are rows (n, S) of booleans over the members."""

from __future__ import annotations

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.defenses.group_testing.memory import JACCARD_REPEAT, PAIR_REPEAT, KeyArray, Memory, keys
from robosac.defenses.group_testing.model import EvidenceModel
from robosac.defenses.group_testing.posterior import EXACT, BoolArray, Posterior

GAIN = 0.26
GAIN_SCALE = 2.0
HARM = 0.35
"""Average precision that m benign messages add, ``GAIN (1 - exp(-m / GAIN_SCALE))``, and that an attacker takes."""
INFORMATION_VALUE = 0.06
"""What a bit about who attacks is worth, in the unit of utility."""
TEST_COST = 0.004
"""What a pass must bring, in the unit of utility."""
UNDILUTED_SIZE = 8
"""Largest subset whose evidence counts in full."""
SUSPECTS_AT_ONCE = 4
"""Most unresolved teammates in a test of a larger team."""
BLOCKS_AT_ONCE = 2
"""Blocks of a larger team that tests are chosen in: those with the most to learn."""
UNRESOLVED = (0.02, 0.995)
"""A teammate with a suspicion between these is unresolved."""
ANSWERS = 4
"""Answers considered in a larger team."""
WITNESSES = 3
"""Trusted teammates that unresolved ones are added to in a larger team."""
_CERTAIN = 1e-12


def gain(sizes: FloatArray | IntArray) -> FloatArray:
    """What the answer of so many benign messages is worth above the ego's own."""
    worth: FloatArray = GAIN * (1.0 - np.exp(-np.asarray(sizes, dtype=np.float64) / GAIN_SCALE))
    return worth


def utility(posterior: Posterior, subsets: BoolArray) -> FloatArray:
    """``U(m) = P(m clean) G(|m|) - (1 - P(m clean)) HARM`` of each subset (n,); the ego's own answer has 0."""
    clean = posterior.unattacked(posterior.masks(subsets))
    worth: FloatArray = clean * gain(subsets.sum(axis=1)) - (1.0 - clean) * HARM
    return worth


def candidates(posterior: Posterior, present: BoolArray, decoded: BoolArray) -> BoolArray:
    """Subsets worth considering, without those decoded: all in a small team; in a larger one the best answers, and up
    to four unresolved teammates of one block, alone or beside trusted ones.

    Parameters
    ----------
    posterior : Posterior
    present : (S,) bool ndarray
    decoded : (m, S) bool ndarray
    """
    here = np.flatnonzero(present)
    found = _all_of(here, len(present)) if len(here) <= EXACT else _some_of(posterior, here, decoded)
    unique = {row.tobytes(): index for index, row in reversed(list(enumerate(np.packbits(found, axis=1))))}
    for row in np.packbits(decoded, axis=1):
        unique.pop(row.tobytes(), None)
    return found[sorted(unique.values())]


def _all_of(members: IntArray, size: int) -> BoolArray:
    """All subsets but the empty one of these members, (2 ** m - 1, size)."""
    codes = np.arange(1, 1 << len(members))
    rows = np.zeros((len(codes), size), dtype=bool)
    rows[:, members] = (codes[:, None] >> np.arange(len(members))) & 1
    return rows


def _some_of(posterior: Posterior, here: IntArray, decoded: BoolArray) -> BoolArray:
    suspicion = posterior.marginals()
    size = len(suspicion)
    low, high = UNRESOLVED
    ranked = here[np.argsort(suspicion[here], kind="stable")]
    answers = np.zeros((ANSWERS, size), dtype=bool)
    for row, count in zip(answers, _answer_sizes(suspicion[ranked]), strict=True):
        row[ranked[:count]] = True
    cleared = np.zeros((1, size), dtype=bool)
    cleared[0, ranked[suspicion[ranked] < low][:WITNESSES]] = True
    witnesses = decoded[(decoded.sum(axis=1) <= WITNESSES) & ~decoded[:, suspicion >= low].any(axis=1)]
    bases = np.concatenate([np.zeros_like(cleared), cleared, witnesses])
    found = [answers]
    for suspects in _most_open(posterior.blocks(), suspicion, here, low, high)[:BLOCKS_AT_ONCE]:
        groups = _all_of(suspects, size)
        groups = groups[groups.sum(axis=1) <= SUSPECTS_AT_ONCE]
        found.append((bases[:, None] | groups[None]).reshape(-1, size))
    return np.concatenate(found)


def _most_open(
    blocks: list[list[str]], suspicion: FloatArray, here: IntArray, low: float, high: float
) -> list[IntArray]:
    """The unresolved teammates of each block, those of most entropy first."""
    unresolved = np.zeros(len(suspicion), dtype=bool)
    unresolved[here] = True
    unresolved &= (suspicion >= low) & (suspicion <= high)
    kept = np.clip(suspicion, _CERTAIN, 1 - _CERTAIN)
    entropy = -(kept * np.log2(kept) + (1 - kept) * np.log2(1 - kept)) * unresolved
    ends = np.cumsum([len(block) for block in blocks])
    parts = [np.arange(end - len(block), end) for block, end in zip(blocks, ends, strict=True)]
    parts.sort(key=lambda part: -float(entropy[part].sum()))
    return [part[unresolved[part]] for part in parts]


def expected_information(
    model: EvidenceModel,
    posterior: Posterior,
    memory: Memory,
    identities: KeyArray,
    subsets: BoolArray,
    decoded: BoolArray,
    *,
    ego_sees: bool,
) -> FloatArray:
    """Bits (n,) that decoding each subset promises: from its Jaccard index (unless the ego sees too little), and from
    the best pair with an already decoded part or superset of it; each times what a repetition is worth.

    Parameters
    ----------
    model : EvidenceModel
    posterior : Posterior
    memory : Memory
    identities : (S,) uint64 ndarray
        Of the members.
    subsets : (n, S) bool ndarray
    decoded : (m, S) bool ndarray
    ego_sees : bool
    """
    bits = np.zeros(len(subsets))
    masks, subset_keys, sizes = posterior.masks(subsets), subsets @ identities, subsets.sum(axis=1)
    if ego_sees:
        cells = posterior.cells(masks, [np.zeros_like(mask) for mask in masks])
        once = memory.weights(keys(subset_keys, np.zeros_like(subset_keys)), JACCARD_REPEAT)
        bits += once * model.jaccard_information(sizes, cells) * dilution(sizes)
    best = np.zeros(len(subsets))
    for other in decoded:
        above, below = (subsets >= other).all(axis=1), (subsets <= other).all(axis=1)
        paired = np.flatnonzero(above | below)
        if not len(paired):
            continue
        a = np.where(above[paired, None], other, subsets[paired])
        d = (subsets[paired] | other) & ~a
        cells = posterior.cells(posterior.masks(a), posterior.masks(d))
        once = memory.weights(keys(a @ identities, d @ identities), PAIR_REPEAT)
        told = model.pair_information(a.sum(axis=1), d.sum(axis=1), cells)
        worth = once * told * dilution((a | d).sum(axis=1))
        best[paired] = np.maximum(best[paired], worth)
    return bits + best


def dilution(sizes: IntArray) -> FloatArray:
    """What evidence of subsets of these sizes (n,) is worth: among more than were calibrated, an attacker is one voice
    among more, and shows less.
    """
    worth: FloatArray = np.minimum(1.0, UNDILUTED_SIZE / sizes)
    return worth


def _answer_sizes(ascending: FloatArray) -> IntArray:
    """How many of the least suspected make the best answers, as if teammates were independent."""
    clean = np.cumprod(1.0 - ascending)
    worth = clean * gain(np.arange(1, len(clean) + 1)) - (1.0 - clean) * HARM
    best: IntArray = np.argsort(-worth, kind="stable")[:ANSWERS] + 1
    return best
