"""Probabilities of who attacks and how, in a form that fits large teams; what can be asked of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.defenses.group_testing import sets
from robosac.defenses.group_testing.blocks import Block, members
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.sets import ATTACKS, BENIGN, PLAIN

BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
_LIMITS = ((BENIGN, BENIGN), (BENIGN, ATTACKS), (ATTACKS, BENIGN), (PLAIN, PLAIN), (PLAIN, BENIGN), (BENIGN, PLAIN))

_OF_A, _OF_D = 2 - np.array(_LIMITS).T[:, :, None]


class Distribution:
    """Probabilities over kinds of attack k and states z of the teammates.

    k = 0 means that nobody attacks. A teammate is plain, complementary (benign, and it sees much of what the others do
    not), or attacking.

    ``P(z, k) = q_k * prod over blocks b of P_b(z within b | k)``: inside a block all states are held, between blocks
    (given the kind) independence is assumed.

    Parameters
    ----------
    weights : (1 + K,) ndarray
        q.
    team : sequence of Block
        At least one.
    """

    def __init__(self, weights: FloatArray, team: Sequence[Block]) -> None:
        self._kinds = len(weights) - 1
        self.version = 0
        """Grows whenever it stands for something else."""
        self._marginals: FloatArray | None = None
        self._powers: FloatArray | None = None
        self._hold(weights, team)

    @property
    def members(self) -> list[str]:
        """The team, block by block: the order of every array over teammates."""
        return members(self._blocks)

    @property
    def nobody(self) -> float:
        """Probability that nobody attacks."""
        return float(self._weights[0])

    def blocks(self) -> list[list[str]]:
        """The team as it is cut into blocks."""
        return [list(block.names) for block in self._blocks]

    def marginals(self) -> FloatArray:
        """Probability (S,) of each member to attack."""
        if self._marginals is None:
            attacking = [sets.attacking(len(block)) @ (self._weights[1:] @ block.table[1:]) for block in self._blocks]
            self._marginals = np.minimum(np.maximum(np.concatenate(attacking), 0.0), 1.0)
        return self._marginals

    def clean_within(self, block: int) -> FloatArray:
        """Probability (2 ** n,) that nobody of each subset of a block attacks, by its mask there."""
        return self._weights @ self._blocks[block].clean

    def masks(self, subsets: BoolArray) -> IntArray:
        """Subsets (n, S), in the order of `members`, as masks (B, n): block by block, bit by bit."""
        if self._powers is None:  # of two, exact as floats, whose products are the fast ones
            starts = np.cumsum([0, *map(len, self._blocks)])
            place = np.arange(starts[-1])[:, None] - starts[:-1]
            inside = (place >= 0) & (place < np.diff(starts))
            self._powers = inside * 2.0 ** (place * inside)
        return (subsets.astype(np.float64) @ self._powers).astype(np.int64).T

    def rows(self, which: IntArray, masks: IntArray) -> BoolArray:
        """Subsets (n, S), each within one block: which block (n,), and its mask there (n,)."""
        starts = np.cumsum([0, *map(len, self._blocks)])
        place = np.arange(starts[-1]) - starts[which, None]
        inside = (place >= 0) & (place < max(map(len, self._blocks)))
        rows: BoolArray = inside & ((masks[:, None] >> np.where(inside, place, 0)) & 1).astype(bool)
        return rows

    def unattacked(self, masks: IntArray) -> FloatArray:
        """Probability (n,) that nobody of each subset attacks."""
        touched = np.flatnonzero(masks.any(axis=1)).tolist() or [0]
        if len(touched) == 1:
            return self.clean_within(touched[0])[masks[touched[0]]]
        clean = self._blocks[touched[0]].clean.take(masks[touched[0]], axis=1)
        for b in touched[1:]:
            clean *= self._blocks[b].clean.take(masks[b], axis=1)
        return self._weights @ clean

    def cells(self, a: IntArray, d: IntArray) -> FloatArray:
        """Joint probabilities (n, CLEAN + 3 K) of what pairs of disjoint subsets hold, by rows of an `EvidenceModel`.

        Columns 0 to 3: no attacker in either; nobody complementary, somebody in d, in a, in both. Then for each kind:
        attackers in d only, in a only, in both.
        """
        q = self._weights
        below = self._at_most(a, d)
        both, in_a, in_d = below[:, 0], below[:, 1], below[:, 2]
        benign, _, _, neither, only_d, only_a = (q @ below.reshape(len(q), -1)).reshape(below.shape[1:])
        only_d, only_a = only_d - neither, only_a - neither
        cells = np.empty((a.shape[1], CLEAN + CELLS * self._kinds))
        cells[:, 0], cells[:, 1], cells[:, 2] = neither, only_d, only_a
        cells[:, 3] = benign - neither - only_d - only_a
        for cell, chance in enumerate((in_a - both, in_d - both, 1 - in_a - in_d + both)):
            np.multiply(chance[1:].T, q[1:], out=cells[:, CLEAN + cell :: CELLS])
        return np.maximum(cells, 0.0)

    def _at_most(self, a: IntArray, d: IntArray) -> FloatArray:
        """Probability (1 + K, L, n), given the kind, that no state in subsets ``a`` is above the first of each of
        `_LIMITS` (L,), and none in ``d`` above the second.
        """
        product = None
        for b in np.flatnonzero((a | d).any(axis=1)).tolist():
            codes = sets.codes(len(self._blocks[b]))
            limits = 2 * codes[-1] - _OF_A * codes[a[b]] - _OF_D * codes[d[b]]
            part = self._blocks[b].below.take(limits, axis=1)
            product = part if product is None else np.multiply(product, part, out=product)
        return np.ones((1 + self._kinds, len(_LIMITS), a.shape[1])) if product is None else product

    def _hold(self, weights: FloatArray, team: Sequence[Block]) -> None:
        """Stand for this from now on."""
        self._weights, self._blocks = weights, list(team)
        self._marginals = self._powers = None
        self.version += 1
