"""How likely a test's outcome is, given who attacks: the calibrated likelihoods of one detector."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.budget import DomainError
from robosac.defenses.group_testing.geometry import PairMeasure
from robosac.defenses.group_testing.strangeness import STRETCHES, stretched

OPEN = "open"
"""The kind of attack that nothing was calibrated for: any outcome of an attacked fusion is as likely as any other."""
LIE = "lie"
"""The kind of attack that changes single objects: whole fusions look as if nobody attacked, and only evidence on
objects tells of it.
"""
LOSS_EDGES = (0.03, 0.045, 0.06, 0.075, 0.09, 0.11, 0.13, 0.16, 0.2, 0.28, 0.4)
NOVELTY_EDGES = (1, 2, 3, 5, 7, 9, 12, 16)
CROWD_EDGES = (16, 21, 26, 31, 36, 41)
CHANGE_EDGES = (1, 2, 3, 5, 8, 12)
LOSS_BINS = len(LOSS_EDGES) + 1
NOVELTY_BINS = len(NOVELTY_EDGES) + 1
BINS = LOSS_BINS * NOVELTY_BINS
CROWD_BINS = len(CROWD_EDGES) + 1
CHANGE_BINS = len(CHANGE_EDGES) + 1
JOINING_SIZES = (5, 3, 2, 2)
"""Numbers of joining teammates told apart beside none (the ego alone), one, two, and three or more."""
SIZES = tuple((a, d) for a, most in enumerate(JOINING_SIZES) for d in range(1, most + 1))
"""Sizes (a, d) told apart; the last ones of each count for all that are larger."""
CLEAN = 4
"""Unattacked cells of a pair (a, d): nobody complementary; somebody in d; in a; in both."""
CELLS = 3
"""Attacked cells of a pair, for each kind: d dirty; a dirty; both dirty."""
CHANGE_SIZES = 5
"""Sizes 1, 2, ... of fusions compared with the frame before; the last one counts for all that are larger."""
_FIRST = np.cumsum([0, *JOINING_SIZES[:-1]])
_MOST = np.array(JOINING_SIZES)
_TINY = 1e-300
_TOLERANCE = 1e-3


class CalibrationError(DomainError):
    """A calibration is missing, damaged, or of other weights."""


def size_row(a: IntArray, d: IntArray) -> IntArray:
    """Which of `SIZES` (n,) pairs of these sizes (n,) and (n,) count as; d at least 1."""
    witnesses = np.minimum(a, len(JOINING_SIZES) - 1)
    row: IntArray = _FIRST[witnesses] + np.minimum(d, _MOST[witnesses]) - 1
    return row


def pair_bin(pair: PairMeasure) -> int:
    """Bin of loss and novelty together."""
    loss = int(np.searchsorted(LOSS_EDGES, pair.loss, side="right"))
    novelty = int(np.searchsorted(NOVELTY_EDGES, pair.novelty, side="right"))
    return loss * NOVELTY_BINS + novelty


def crowd_bin(boxes: int) -> int:
    """Bin of a number of boxes."""
    return int(np.searchsorted(CROWD_EDGES, boxes, side="right"))


def change_bin(changes: int) -> int:
    """Bin of a number of boxes that came or went."""
    return int(np.searchsorted(CHANGE_EDGES, changes, side="right"))


@dataclass(frozen=True)
class EvidenceModel:
    """Likelihoods at one level of pose error.

    Rows of the table stand for what is true: `CLEAN` rows for unattacked pairs, then for each kind of attack `CELLS`.
    """

    pose_error_m: float
    """Standard deviation of the teammates' positions that it was calibrated at, metres."""
    kinds: tuple[str, ...]
    """Kinds of attack, `OPEN` among them."""
    pairs: FloatArray
    """(CLEAN + 3 K, len(SIZES), BINS): each last axis sums to 1."""
    changes: FloatArray
    """(1 + K, CHANGE_SIZES, CROWD_BINS, CHANGE_BINS): how many boxes come or go from one frame to the next in a fusion
    with so many boxes: unattacked, and attacked by each kind in both frames. Each last axis sums to 1.
    """
    coarse: tuple[int, int] = (2, 2)
    """(int, int): neighbouring bins of loss, and of novelty, that are taken together to reckon what a test promises,
    which need not be known exactly.
    """

    def __post_init__(self) -> None:
        kinds = len(self.kinds)
        shapes = {
            "pairs": (CLEAN + CELLS * kinds, len(SIZES), BINS),
            "changes": (1 + kinds, CHANGE_SIZES, CROWD_BINS, CHANGE_BINS),
        }
        for name, shape in shapes.items():
            table = getattr(self, name)
            if table.shape != shape:
                raise CalibrationError(f"{name} must have the shape {shape}, got {table.shape}")
            if not (table > 0).all() or abs(table.sum(axis=-1) - 1).max() > _TOLERANCE:
                raise CalibrationError(f"{name} must hold positive probabilities that sum to 1")

    @cached_property
    def with_lies(self) -> EvidenceModel:
        """The same likelihoods, and those of the kind `LIE`, which are the unattacked ones."""
        pairs = np.concatenate([self.pairs, np.repeat(self.pairs[:1], CELLS, axis=0)])
        changes = np.concatenate([self.changes, self.changes[:1]])
        return EvidenceModel(self.pose_error_m, (*self.kinds, LIE), pairs, changes, self.coarse)

    @cached_property
    def lie(self) -> int | None:
        """Which of the kinds is `LIE`; None if none is."""
        return self.kinds.index(LIE) if LIE in self.kinds else None

    @cached_property
    def _by_size(self) -> FloatArray:
        """The table (len(SIZES), CLEAN + 3 K, BINS)."""
        return np.ascontiguousarray(self.pairs.swapaxes(0, 1))

    @cached_property
    def _parts(self) -> FloatArray:
        """1 for the part of a pair that each row has attackers in (CLEAN + 3 K, 4): nowhere, d, a, both."""
        return np.concatenate([np.eye(1 + CELLS)[[0] * CLEAN], *[np.eye(1 + CELLS)[1:]] * len(self.kinds)])

    @cached_property
    def _by_part(self) -> FloatArray:
        """The table (len(SIZES), CLEAN + 3 K, 4 x fewer bins), each row beside zeros for the other parts."""
        grid = self._by_size.reshape(*self._by_size.shape[:2], LOSS_BINS, NOVELTY_BINS)
        for axis, width in enumerate(self.coarse, start=2):
            grid = np.add.reduceat(grid, np.arange(0, grid.shape[axis], width), axis=axis)
        apart = self._parts[None, :, :, None] * grid.reshape(*grid.shape[:2], 1, -1)
        return apart.reshape(*grid.shape[:2], -1)

    @cached_property
    def most_telling(self) -> tuple[FloatArray, FloatArray]:
        """Relative entropies (K,) of outcomes under each kind of attack to honest ones, at most, bits: of a fusion
        beside the ego and beside a part of it together, and of a fusion beside itself in the frame before.
        """
        honest, attacked = self._by_size[:, None, :CLEAN], self._by_size[:, CLEAN:, None]
        pairs = _differ(attacked, honest).reshape(len(SIZES), len(self.kinds), -1).max(axis=2)
        beside_ego = np.array([a == 0 for a, _ in SIZES])
        changed = _differ(self.changes[1:], self.changes[0]).reshape(len(self.kinds), -1)
        return pairs[beside_ego].max(axis=0) + pairs[~beside_ego].max(axis=0), changed.max(axis=1)

    def tables(self, a: IntArray, d: IntArray) -> FloatArray:
        """Tables (n, CLEAN + 3 K, BINS) for pairs of these sizes (n,) and (n,); d at least 1."""
        return self._by_size[size_row(a, d)]

    @cached_property
    def _stretched_pairs(self) -> FloatArray:
        """`pairs` in each world of `STRETCHES`: what honest messages show is stretched, (worlds, ...)."""
        honest = [*range(CLEAN), *(row for row in range(CLEAN, len(self.pairs)) if self._kind(row) == LIE)]
        grid = self.pairs[honest].reshape(len(honest), -1, LOSS_BINS, NOVELTY_BINS)
        worlds = np.repeat(self.pairs[None], len(STRETCHES), axis=0)
        for world, stretch in zip(worlds, STRETCHES, strict=True):
            moved = np.einsum(
                "rsab,ac,bd->rscd", grid, stretched(LOSS_EDGES, stretch), stretched(NOVELTY_EDGES, stretch)
            )
            world[honest] = moved.reshape(len(honest), -1, BINS)
        return worlds

    @cached_property
    def _stretched_changes(self) -> FloatArray:
        """`changes` in each world, likewise."""
        honest = [0, *(row for row, kind in enumerate(self.kinds, start=1) if kind == LIE)]
        worlds = np.repeat(self.changes[None], len(STRETCHES), axis=0)
        for world, stretch in zip(worlds, STRETCHES, strict=True):
            world[honest] = self.changes[honest] @ stretched(CHANGE_EDGES, stretch)
        return worlds

    def _kind(self, row: int) -> str:
        """The kind of attack that an attacked row of `pairs` is about."""
        return self.kinds[(row - CLEAN) // CELLS]

    def pair(self, a: int, d: int, measured: PairMeasure) -> FloatArray:
        """Likelihoods (worlds, CLEAN + 3 K) of what a pair of these sizes shows, d at least 1, in each of
        `STRETCHES`.
        """
        row = SIZES.index((min(a, len(JOINING_SIZES) - 1), min(d, JOINING_SIZES[min(a, len(JOINING_SIZES) - 1)])))
        return self._stretched_pairs[:, :, row, pair_bin(measured)]

    def change(self, size: int, boxes: int, changes: int) -> FloatArray:
        """Likelihoods (worlds, CLEAN + 3 K), by the rows of `pairs`, of so many changes in a fusion of this many
        teammates in which there are so many boxes. The teammates are d; nobody is in a.
        """
        table = self._stretched_changes[:, :, min(size, CHANGE_SIZES) - 1, crowd_bin(boxes), change_bin(changes)]
        return np.concatenate([np.repeat(table[:, :1], CLEAN, axis=1), np.repeat(table[:, 1:], CELLS, axis=1)], axis=1)

    def change_information(self, sizes: IntArray, boxes: IntArray, cells: FloatArray) -> FloatArray:
        """Bits (n,) that fusions of so many teammates (n,) promise about who attacks, by what changed since the frame
        before, when they showed so many boxes (n,); ``cells`` as for `information`.
        """
        tables = self.changes[:, np.minimum(sizes, CHANGE_SIZES) - 1, np.searchsorted(CROWD_EDGES, boxes, side="right")]
        clean, attacked = cells[:, :CLEAN].sum(axis=1), cells[:, CLEAN::CELLS]
        by_kind = (attacked[:, None] @ tables[1:].swapaxes(0, 1))[:, 0]
        shown = np.stack([clean[:, None] * tables[0], by_kind], axis=1)
        bits = _entropy(np.stack([clean, attacked.sum(axis=1)], axis=1))
        bits += _entropy(shown.sum(axis=1)) - _entropy(shown.reshape(len(shown), -1))
        return np.maximum(bits, 0.0)

    def information(self, a: IntArray, d: IntArray, cells: FloatArray) -> FloatArray:
        """Bits (n,) that pairs of these sizes promise about who attacks: the entropy of the outcome less what is left
        of it once it is known in which part attackers are. Neither their kind nor whose view is complementary is worth
        knowing in itself.

        Parameters
        ----------
        a, d : (n,) int ndarray
            Sizes; d at least 1.
        cells : (n, CLEAN + 3 K) ndarray
            Probability of what is true.
        """
        which = size_row(a, d)
        shown = np.empty((len(which), self._by_part.shape[2]))
        for index in set(which.tolist()):
            rows = np.flatnonzero(which == index)
            shown[rows] = cells[rows] @ self._by_part[index]
        by_part = shown.reshape(len(which), 1 + CELLS, -1)
        bits = _entropy(cells @ self._parts) + _entropy(by_part.sum(axis=1)) - _entropy(shown)
        return np.maximum(bits, 0.0)


def _entropy(p: FloatArray) -> FloatArray:
    """Sum of -p log2 p over the last axis."""
    bits: FloatArray = -np.vecdot(p, np.log2(np.maximum(p, _TINY)))
    return bits


def _differ(p: FloatArray, q: FloatArray) -> FloatArray:
    """Relative entropy of p to q over the last axis, bits."""
    bits: FloatArray = np.vecdot(p, np.log2(p / q))
    return bits
