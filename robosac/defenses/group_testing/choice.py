"""What a subset is worth: as an answer, and for what it tells. Subsets are rows (n, S) of booleans over the members."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing.geometry import crowd
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import CHANGE_REPEAT, EGO_REPEAT, PAIR_REPEAT, KeyArray, keys
from robosac.defenses.group_testing.posterior import EXACT

GAIN = 0.26
GAIN_SCALE = 2.0
HARM = 0.35
"""Average precision that m benign messages add, ``GAIN (1 - exp(-m / GAIN_SCALE))``, and that an attacker takes."""
MORE_GAIN = 0.09
MORE_SCALE = 4.5
"""What messages beyond `EXACT` add besides, ``MORE_GAIN (1 - exp(-(m - EXACT) / MORE_SCALE))``: in scenes of twenty
cars AP50 grows by .05 and AP70 by .12 from six messages to twenty.
"""
INFORMATION_VALUE = 0.06
"""What a bit about who attacks is worth, in the unit of utility."""
LASTING = 30.0
"""So many times that where a frame has time for one pass alone. Nothing can be found out beside the answer there, and
what is found out serves the frames to come.
"""
TEST_COST = 0.004
"""What a pass must bring, in the unit of utility."""
DEPENDENCE = 0.85
"""Weight of a comparison within a frame: what makes one outcome odd, a crossing or a crowd, makes others odd too."""
LIKELY_HONEST = 0.5
"""Whoever is less suspected is more likely honest than not."""
UNDILUTED_SIZE = 8
"""Largest subset whose evidence counts in full."""
_CERTAIN = 1e-12


def gain(sizes: FloatArray | IntArray) -> FloatArray:
    """What the answer of so many benign messages is worth above the ego's own."""
    m = np.asarray(sizes, dtype=np.float64)
    more: FloatArray = MORE_GAIN * (1.0 - np.exp(-np.maximum(m - EXACT, 0.0) / MORE_SCALE))
    return GAIN * (1.0 - np.exp(-m / GAIN_SCALE)) + more


@lru_cache(maxsize=16)
def _gains(most: int) -> FloatArray:
    """`gain` of none up to the most messages."""
    gains: FloatArray = gain(np.arange(most + 1))
    return gains


def utility(known: Knowledge, subsets: BoolArray) -> FloatArray:
    """What each subset (n,) is worth as an answer; the ego's own has 0.

    ``U(m) = P(m clean) G(|m|) - (1 - P(m clean)) HARM``. In a team of more than `EXACT`
    ``U(m) = P(m clean) G(h) + P(m lying) (G(h) - HARM min(1, EXACT / |m|)) - P(m attacked) HARM``, with h those of m
    who are more likely honest than not. Nobody of m attacks; or whoever does lies about single objects, and takes
    nothing from what the others add, as each box is judged by the testimony of many, and less where it is one voice
    among more; or somebody attacks in another way.
    """
    posterior, lie = known.posterior, known.model.lie
    by_kind = posterior.unattacked_by_kind(posterior.masks(subsets))
    clean, gains, sizes = by_kind.sum(axis=1), _gains(subsets.shape[1]), subsets.sum(axis=1)
    if lie is None or subsets.shape[1] <= EXACT:
        worth: FloatArray = clean * gains[sizes] - (1.0 - clean) * HARM
    else:
        lying = np.maximum(posterior.by_kind[lie] - by_kind[:, 1 + lie], 0.0)
        honest = (subsets & (posterior.marginals() < LIKELY_HONEST)).sum(axis=1)
        harm = HARM * (1.0 - clean - lying * np.maximum(0.0, 1.0 - EXACT / np.maximum(sizes, 1)))
        worth = (clean + lying) * gains[honest] - harm
    return worth


def expected_information(known: Knowledge, subsets: BoolArray, decoded: BoolArray, *, ego_sees: bool) -> FloatArray:
    """Bits (n,) that decoding each subset promises about who attacks.

    They come from comparing it with the ego alone, with itself in the frame before (if it was decoded there), and with
    the best of its parts and supersets decoded already. Each counts as much as a repetition is worth.

    Parameters
    ----------
    known : Knowledge
    subsets : (n, S) bool ndarray
    decoded : (m, S) bool ndarray
    ego_sees : bool
        Whether the ego alone sees enough to compare with.
    """
    posterior, memory = known.posterior, known.memory
    count, bits = len(subsets), np.zeros(len(subsets))
    masks, subset_keys, sizes = posterior.masks(subsets), known.keys(subsets), subsets.sum(axis=1)
    nobody, nothing = np.zeros_like(sizes), np.zeros_like(subset_keys)
    pairs = _pairs(known, subsets, decoded)
    # all at once, beside the ego and in pairs
    cells = posterior.cells(*(np.hstack(of) for of in ((np.zeros_like(masks), pairs.a), (masks, pairs.d))))
    a_sizes, d_sizes = np.append(nobody, pairs.a_sizes), np.append(sizes, pairs.d_sizes)
    told = DEPENDENCE * known.model.information(a_sizes, d_sizes, cells) * dilution(a_sizes + d_sizes)
    if ego_sees:
        bits += memory.weights(keys(nothing, subset_keys), EGO_REPEAT) * told[:count]
    again = np.flatnonzero([key in memory.shown for key in subset_keys.tolist()])
    if len(again):
        once = memory.weights(keys(subset_keys[again], nothing[again]), CHANGE_REPEAT)
        boxes = np.array([crowd(memory.shown[key]) for key in subset_keys[again].tolist()])
        changed = known.model.change_information(sizes[again], boxes, cells[again])
        bits[again] += once * changed * dilution(sizes[again])
    best = np.zeros(count)
    np.maximum.at(best, pairs.subset, memory.weights(pairs.keys, PAIR_REPEAT) * told[count:])
    return (bits + best) * memory.trust


def most_information(known: Knowledge, subsets: BoolArray) -> FloatArray:
    """Bits (n,) that `expected_information` does not exceed before anything is decoded: neither comparison tells more
    than is open, the entropy of whether a subset is attacked.
    """
    posterior, memory = known.posterior, known.memory
    p = np.minimum(np.maximum(posterior.unattacked(posterior.masks(subsets)), _CERTAIN), 1.0 - _CERTAIN)
    doubt = -(p * np.log2(p) + (1.0 - p) * np.log2(1.0 - p))
    again = [key in memory.shown for key in known.keys(subsets).tolist()]
    most: FloatArray = doubt * (DEPENDENCE + np.array(again)) * memory.trust
    return most


def most_promised(known: Knowledge) -> float:
    """Bits that `expected_information` does not exceed for any subset: an outcome tells at most the relative entropy of
    what is attacked to what is not, times how likely an attack is.
    """
    of_pairs, of_changes = known.model.most_telling
    return float(known.posterior.by_kind @ (DEPENDENCE * of_pairs + of_changes)) * known.memory.trust


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs (p,) that subsets would make with parts or supersets of them."""

    subset: IntArray
    """(p,): which subset."""
    a: IntArray
    d: IntArray
    """(B, p): masks of the smaller one, and of what the larger one has more."""
    a_sizes: IntArray
    d_sizes: IntArray
    keys: KeyArray
    """(p,): of the tests, as memory knows them."""


def _pairs(known: Knowledge, subsets: BoolArray, decoded: BoolArray) -> _Pairs:
    posterior = known.posterior
    sizes, other_sizes = subsets.sum(axis=1), decoded.sum(axis=1)
    shared = subsets.astype(np.float64) @ decoded.T  # exact as floats, whose products are the fast ones
    above = shared == other_sizes
    index, other = np.nonzero(above | (shared == sizes[:, None]))
    masks, other_masks = posterior.masks(subsets)[:, index], posterior.masks(decoded)[:, other]
    own_keys, other_keys = known.keys(subsets)[index], known.keys(decoded)[other]
    grows = above[index, other]
    a_keys, ad_keys = np.where(grows, (other_keys, own_keys), (own_keys, other_keys))
    a_sizes, together = np.minimum(sizes[index], other_sizes[other]), np.maximum(sizes[index], other_sizes[other])
    a = np.where(grows, other_masks, masks)
    return _Pairs(index, a, masks ^ other_masks, a_sizes, together - a_sizes, keys(a_keys, ad_keys - a_keys))


def dilution(sizes: IntArray) -> FloatArray:
    """Weight (n,) of evidence from subsets of these sizes (n,): in larger ones than were calibrated, an attacker shows
    less.
    """
    return np.minimum(1.0, UNDILUTED_SIZE / sizes)
