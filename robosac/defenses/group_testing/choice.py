"""What a subset is worth: as an answer, and for what it tells. Subsets are rows (n, S) of booleans over the members."""

from __future__ import annotations

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.defenses.group_testing.geometry import crowd
from robosac.defenses.group_testing.memory import CHANGE_REPEAT, EGO_REPEAT, PAIR_REPEAT, KeyArray, Memory, keys
from robosac.defenses.group_testing.model import EvidenceModel
from robosac.defenses.group_testing.posterior import BoolArray, Posterior

GAIN = 0.26
GAIN_SCALE = 2.0
HARM = 0.35
"""Average precision that m benign messages add, ``GAIN (1 - exp(-m / GAIN_SCALE))``, and that an attacker takes."""
INFORMATION_VALUE = 0.06
"""What a bit about who attacks is worth, in the unit of utility."""
TEST_COST = 0.004
"""What a pass must bring, in the unit of utility."""
DEPENDENCE = 0.85
"""What a comparison within a frame counts: what makes one outcome odd, a crossing or a crowd, makes others odd too."""
UNDILUTED_SIZE = 8
"""Largest subset whose evidence counts in full."""


def gain(sizes: FloatArray | IntArray) -> FloatArray:
    """What the answer of so many benign messages is worth above the ego's own."""
    worth: FloatArray = GAIN * (1.0 - np.exp(-np.asarray(sizes, dtype=np.float64) / GAIN_SCALE))
    return worth


def utility(posterior: Posterior, subsets: BoolArray) -> FloatArray:
    """``U(m) = P(m clean) G(|m|) - (1 - P(m clean)) HARM`` of each subset (n,); the ego's own answer has 0."""
    clean = posterior.unattacked(posterior.masks(subsets))
    worth: FloatArray = clean * gain(subsets.sum(axis=1)) - (1.0 - clean) * HARM
    return worth


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
    """Bits (n,) that decoding each subset promises: beside the ego alone (unless that sees too little), beside itself
    in the frame before (if it was decoded there), and from the best pair with an already decoded part or superset of
    it; each times what a repetition is worth.

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
    nobody, nothing = np.zeros_like(sizes), np.zeros_like(subset_keys)
    alone = posterior.cells(np.zeros_like(masks), masks)
    if ego_sees:
        once = memory.weights(keys(nothing, subset_keys), EGO_REPEAT)
        bits += DEPENDENCE * once * model.information(nobody, sizes, alone) * dilution(sizes)
    again = np.flatnonzero([key in memory.shown for key in subset_keys.tolist()])
    if len(again):
        once = memory.weights(keys(subset_keys[again], nothing[again]), CHANGE_REPEAT)
        boxes = np.array([crowd(memory.shown[key]) for key in subset_keys[again].tolist()])
        told = model.change_information(sizes[again], boxes, alone[again])
        bits[again] += once * told * dilution(sizes[again])
    shared = subsets.astype(np.float64) @ decoded.T  # exact as floats, whose products are the fast ones
    other_sizes = decoded.sum(axis=1)
    above = shared == other_sizes
    index, other = np.nonzero(above | (shared == sizes[:, None]))
    if not len(index):
        return bits
    other_masks, other_keys = posterior.masks(decoded), decoded @ identities
    grows = above[index, other]
    a_keys = np.where(grows, other_keys[other], subset_keys[index])
    d_keys = np.where(grows, subset_keys[index], other_keys[other]) - a_keys
    a_sizes, together = np.minimum(sizes[index], other_sizes[other]), np.maximum(sizes[index], other_sizes[other])
    a_masks = np.where(grows, other_masks[:, other], masks[:, index])
    cells = posterior.cells(a_masks, masks[:, index] ^ other_masks[:, other])
    told = model.information(a_sizes, together - a_sizes, cells)
    once = memory.weights(keys(a_keys, d_keys), PAIR_REPEAT)
    best = np.zeros(len(subsets))
    np.maximum.at(best, index, DEPENDENCE * once * told * dilution(together))
    return bits + best


def dilution(sizes: IntArray) -> FloatArray:
    """What evidence of subsets of these sizes (n,) is worth: among more than were calibrated, an attacker is one voice
    among more, and shows less.
    """
    worth: FloatArray = np.minimum(1.0, UNDILUTED_SIZE / sizes)
    return worth
