"""Probabilities of who attacks and how, in a form that fits large teams; what can be asked of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing import sets
from robosac.defenses.group_testing.blocks import Block
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.sets import ATTACKS, BENIGN, PLAIN

_LIMITS = ((BENIGN, BENIGN), (BENIGN, ATTACKS), (ATTACKS, BENIGN), (PLAIN, PLAIN), (PLAIN, BENIGN), (BENIGN, PLAIN))

_OF_A, _OF_D = 2 - np.array(_LIMITS).T[:, :, None]
_UNATTACKED = np.array(
    [[0, 0, 0, 1, 0, 0], [0, 0, 0, -1, 1, 0], [0, 0, 0, -1, 0, 1], [1, 0, 0, 1, -1, -1]], dtype=float
)
_ATTACKED = np.array([[-1, 1, 0, 0, 0, 0], [-1, 0, 1, 0, 0, 0], [1, -1, -1, 0, 0, 0]], dtype=float)
_CERTAIN = np.array([[0.0], [0.0], [1.0]])
"""What is unattacked (CLEAN,), and attacked (CELLS,), by what is below `_LIMITS` (L,), and by what is certain."""


class Distribution:
    """Probabilities over kinds of attack k and states z of the teammates.

    k = 0 means that nobody attacks. A teammate is plain, complementary (benign, and it sees much of what the others do
    not), or attacking.

    ``P(z, k) = q_k * prod over blocks b of P_b(z within b | k)``: inside a block all states are held, between blocks
    (given the kind) independence is assumed. All tables have the size of the largest block's: a smaller block is filled
    up with members that are plain for certain.

    Parameters
    ----------
    weights : (1 + K,) ndarray
        q.
    team : sequence of Block
        At least one.
    """

    def __init__(self, weights: FloatArray, team: Sequence[Block]) -> None:
        self.version = 0
        """Grows whenever it stands for something else."""
        self._kinds = len(weights) - 1
        self._marginals: FloatArray | None = None
        self._known_below: FloatArray | None = None
        self._known_clean: FloatArray | None = None
        self._hold(weights, team)

    @property
    def members(self) -> list[str]:
        """The team, block by block: the order of every array over teammates."""
        return [name for names in self._names for name in names]

    @property
    def nobody(self) -> float:
        """Probability that nobody attacks."""
        return float(self._weights[0])

    @property
    def by_kind(self) -> FloatArray:
        """Probability (K,) of an attack of each kind."""
        attacked: FloatArray = self._weights[1:]
        return attacked

    def blocks(self) -> list[list[str]]:
        """The team as it is cut into blocks."""
        return [list(names) for names in self._names]

    @property
    def _blocks(self) -> list[Block]:
        """The blocks one by one."""
        return [
            Block(names, table[:, : sets.STATES ** len(names)])
            for names, table in zip(self._names, self._tables, strict=True)
        ]

    def marginals(self) -> FloatArray:
        """Probability (S,) of each member to attack."""
        if self._marginals is None:
            entries = (self._weights[1:] @ self._tables[:, 1:]) @ sets.attacking(self._width).T
            self._marginals = np.minimum(np.maximum(entries[self._inside], 0.0), 1.0)
        return self._marginals

    def clean_within(self, block: int) -> FloatArray:
        """Probability (2 ** n,) that nobody of each subset of a block attacks, by its mask there."""
        within: FloatArray = self._weights @ self._clean[block]
        return within[: 1 << len(self._names[block])]

    def masks(self, subsets: BoolArray) -> IntArray:
        """Subsets (n, S), in the order of `members`, as masks (B, n): block by block, bit by bit."""
        return (subsets.astype(np.float64) @ self._powers).astype(np.int64).T

    def rows(self, which: IntArray, masks: IntArray) -> BoolArray:
        """Subsets (n, S), each within one block: which block (n,), and its mask there (n,)."""
        starts = np.cumsum([0, *self._sizes])
        place = np.arange(starts[-1]) - starts[which, None]
        inside = (place >= 0) & (place < self._width)
        rows: BoolArray = inside & ((masks[:, None] >> np.where(inside, place, 0)) & 1).astype(bool)
        return rows

    def unattacked(self, masks: IntArray) -> FloatArray:
        """Probability (n,) that nobody of each subset attacks."""
        unattacked: FloatArray = self.unattacked_by_kind(masks).sum(axis=1)
        return unattacked

    def unattacked_by_kind(self, masks: IntArray) -> FloatArray:
        """Probability (n, 1 + K) that nobody attacks, or somebody in each way, and nobody of each subset does."""
        clean = self._clean[np.arange(len(masks))[:, None], :, masks]  # (B, n, 1 + K)
        by_kind: FloatArray = clean.prod(axis=0) * self._weights
        return by_kind

    def cells(self, a: IntArray, d: IntArray) -> FloatArray:
        """Joint probabilities (n, CLEAN + 3 K) of what pairs of disjoint subsets hold, by rows of an `EvidenceModel`.

        Columns 0 to 3: no attacker in either; nobody complementary, somebody in d, in a, in both. Then for each kind:
        attackers in d only, in a only, in both.
        """
        q = self._weights[:, None, None]
        below = q * self._at_most(a, d)
        cells = np.empty((CLEAN + CELLS * self._kinds, a.shape[1]))
        cells[:CLEAN] = _UNATTACKED @ below.sum(axis=0)
        cells[CLEAN:] = (_ATTACKED @ below[1:] + _CERTAIN * q[1:]).reshape(-1, a.shape[1])
        return np.maximum(cells.T, 0.0)

    def _at_most(self, a: IntArray, d: IntArray) -> FloatArray:
        """Probability (1 + K, L, n), given the kind, that no state in subsets ``a`` is above the first of each of
        `_LIMITS` (L,), and none in ``d`` above the second.
        """
        codes = sets.codes(self._width)
        touched = np.flatnonzero((a | d).any(axis=1))
        touched = touched if len(touched) else np.zeros(1, dtype=np.int64)
        limits = 2 * codes[-1] - _OF_A * codes[a[touched]][:, None] - _OF_D * codes[d[touched]][:, None]  # (b, L, n)
        each: FloatArray = np.moveaxis(self._below, 1, 2)[touched[:, None, None], limits]  # (b, L, n, 1 + K)
        return np.moveaxis(np.multiply.reduce(each, axis=0), -1, 0)

    @property
    def _below(self) -> FloatArray:
        """Probability (B, 1 + K, 3 ** n), given the kind, that no state of each block is above given ones."""
        if self._known_below is None:
            self._known_below = sets.at_most(self._tables)
        return self._known_below

    @property
    def _clean(self) -> FloatArray:
        """Probability (B, 1 + K, 2 ** n), given the kind, that nobody of each subset of each block attacks."""
        if self._known_clean is None:
            codes = sets.codes(self._width)
            self._known_clean = self._below.take(2 * codes[-1] - codes, axis=2)
        return self._known_clean

    def _hold(self, weights: FloatArray, team: Sequence[Block]) -> None:
        """Stand for these blocks from now on."""
        self._names = [block.names for block in team]
        self._sizes = np.array([len(block) for block in team])
        self._width = int(self._sizes.max())
        self._inside = np.arange(self._width) < self._sizes[:, None]
        start, powers = 0, np.zeros((int(self._sizes.sum()), len(team)))
        for b, size in enumerate(self._sizes.tolist()):  # of two, exact as floats, whose products are the fast ones
            powers[start : start + size, b] = 2.0 ** np.arange(size)
            start += size
        self._powers = powers
        tables = np.zeros((len(team), len(weights), sets.STATES**self._width))
        for padded, block in zip(tables, team, strict=True):
            padded[:, : block.table.shape[1]] = block.table
        self._replace(weights, tables)

    def _replace(self, weights: FloatArray, tables: FloatArray, below: FloatArray | None = None) -> None:
        """The same blocks with other tables (B, 1 + K, 3 ** n), and weights that need not sum to 1."""
        self._weights, self._tables = weights / weights.sum(), tables
        self._known_below, self._known_clean, self._marginals = below, None, None
        self.version += 1
