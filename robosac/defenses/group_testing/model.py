"""How likely a test's outcome is, given who attacks: the calibrated likelihoods of one detector."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.budget import DomainError
from robosac.defenses.group_testing.geometry import PairMeasure

FORMAT = 1
OPEN = "open"
"""The kind of attack that nothing was calibrated for: any outcome of an attacked fusion is as likely as any other."""
JACCARD_EDGES = tuple(np.round(np.arange(0.1, 1.0, 0.1), 1).tolist())
LOSS_EDGES = (0.03, 0.045, 0.06, 0.075, 0.09, 0.11, 0.13, 0.16, 0.2, 0.28, 0.4)
NOVELTY_EDGES = (1, 2, 4, 7)
JACCARD_BINS = len(JACCARD_EDGES) + 1
LOSS_BINS = len(LOSS_EDGES) + 1
NOVELTY_BINS = len(NOVELTY_EDGES) + 1
SIZES = 5
"""Sizes of a subset told apart by the Jaccard index: 1 to 5; larger ones count as 5."""
WITNESS_SIZES = 3
"""Sizes of the smaller fusion of a pair told apart."""
JOINING_SIZES = 2
"""Numbers of joining teammates told apart."""
CELLS = 3
"""Attacked cells of a pair (a, d), after the one where both are clean: d dirty; a dirty; both dirty."""
_TOLERANCE = 1e-3


class CalibrationError(DomainError):
    """A calibration is missing, damaged, or of other weights."""


def jaccard_bin(jaccard_index: float) -> int:
    """Bin of a Jaccard index."""
    return int(np.searchsorted(JACCARD_EDGES, jaccard_index, side="right"))


def pair_bin(pair: PairMeasure) -> int:
    """Bin of loss and novelty together."""
    loss = int(np.searchsorted(LOSS_EDGES, pair.loss, side="right"))
    novelty = int(np.searchsorted(NOVELTY_EDGES, pair.novelty, side="right"))
    return loss * NOVELTY_BINS + novelty


@dataclass(frozen=True)
class EvidenceModel:
    """Likelihoods at one level of pose error.

    Rows of a table stand for what is true: row 0 for an unattacked fusion (or pair), then for each kind of attack one
    row (Jaccard index) or `CELLS` rows (pairs).

    Attributes
    ----------
    pose_error_m : float
        Standard deviation of the teammates' positions that it was calibrated at, metres.
    kinds : tuple of str
        Kinds of attack, `OPEN` last.
    jaccard : (1 + K, SIZES, JACCARD_BINS) ndarray
        Each last axis sums to 1.
    pairs : (1 + 3 K, WITNESS_SIZES, JOINING_SIZES, LOSS_BINS * NOVELTY_BINS) ndarray
        Each last axis sums to 1.
    """

    pose_error_m: float
    kinds: tuple[str, ...]
    jaccard: FloatArray
    pairs: FloatArray

    def __post_init__(self) -> None:
        k = len(self.kinds)
        shapes = {
            "jaccard": (1 + k, SIZES, JACCARD_BINS),
            "pairs": (1 + CELLS * k, WITNESS_SIZES, JOINING_SIZES, LOSS_BINS * NOVELTY_BINS),
        }
        for name, shape in shapes.items():
            table = getattr(self, name)
            if table.shape != shape:
                raise CalibrationError(f"{name} must have the shape {shape}, got {table.shape}")
            if not (table > 0).all() or abs(table.sum(axis=-1) - 1).max() > _TOLERANCE:
                raise CalibrationError(f"{name} must hold positive probabilities that sum to 1")

    @cached_property
    def as_cells(self) -> FloatArray:
        """The Jaccard tables (SIZES, 1 + 3 K, JACCARD_BINS) as those of a pair (a, nobody), of which d is never
        dirty.
        """
        rows = np.repeat(self.jaccard[:1], 1 + CELLS * len(self.kinds), axis=0)
        for cell in (1, 2):  # a dirty; "both dirty" cannot be, and gets the same row
            rows[1 + cell :: CELLS] = self.jaccard[1:]
        cells: FloatArray = np.ascontiguousarray(rows.swapaxes(0, 1))
        return cells

    @cached_property
    def by_size(self) -> FloatArray:
        """The pair tables (WITNESS_SIZES * JOINING_SIZES, 1 + 3 K, bins)."""
        tables = np.moveaxis(self.pairs, 0, 2).reshape(-1, len(self.pairs), self.pairs.shape[-1])
        return np.ascontiguousarray(tables)

    @cached_property
    def entropies(self) -> tuple[FloatArray, FloatArray]:
        """Entropy of each row of `as_cells` and of `by_size`, bits."""
        of_index, of_pair = (-(tables * np.log2(tables)).sum(axis=-1) for tables in (self.as_cells, self.by_size))
        return of_index, of_pair

    def jaccard_tables(self, sizes: IntArray) -> FloatArray:
        """Tables (n, 1 + 3 K, JACCARD_BINS) for subsets of these sizes (n,)."""
        tables: FloatArray = self.as_cells[_size_row(sizes)]
        return tables

    def pair_tables(self, witnesses: IntArray, joining: IntArray) -> FloatArray:
        """Tables (n, 1 + 3 K, bins) for pairs of these sizes (n,) and (n,), each at least 1."""
        tables: FloatArray = self.by_size[_pair_row(witnesses, joining)]
        return tables

    def jaccard_information(self, sizes: IntArray, cells: FloatArray) -> FloatArray:
        """Bits (n,) that the Jaccard index of subsets of these sizes (n,) promises about what is true.

        Parameters
        ----------
        sizes : (n,) int ndarray
        cells : (n, 1 + 3 K) ndarray
            Probability of what is true.
        """
        return _information(self.as_cells, self.entropies[0], _size_row(sizes), cells)

    def pair_information(self, witnesses: IntArray, joining: IntArray, cells: FloatArray) -> FloatArray:
        """The same of pairs of these sizes (n,) and (n,)."""
        return _information(self.by_size, self.entropies[1], _pair_row(witnesses, joining), cells)


def _size_row(sizes: IntArray) -> IntArray:
    row: IntArray = np.minimum(sizes, SIZES) - 1
    return row


def _pair_row(witnesses: IntArray, joining: IntArray) -> IntArray:
    row: IntArray = (np.minimum(witnesses, WITNESS_SIZES) - 1) * JOINING_SIZES + np.minimum(joining, JOINING_SIZES) - 1
    return row


def _information(tables: FloatArray, entropies: FloatArray, which: IntArray, cells: FloatArray) -> FloatArray:
    """Mutual information (n,): the entropy of the outcome less what is left of it once the truth is known."""
    bits = np.empty(len(which))
    for index in np.unique(which):
        rows = which == index
        mixed = cells[rows] @ tables[index]
        bits[rows] = -(mixed * np.log2(mixed)).sum(axis=1) - cells[rows] @ entropies[index]
    return np.maximum(bits, 0.0)


@dataclass(frozen=True)
class Calibration:
    """The likelihoods of one detector, at several levels of pose error.

    Attributes
    ----------
    detector : str
    weights_digest : str
        SHA-256 of the weights file that it belongs to, hexadecimal.
    recipe : mapping
        How it was made; JSON values.
    levels : tuple of EvidenceModel
        Ascending pose error.
    """

    detector: str
    weights_digest: str
    recipe: Mapping[str, Any]
    levels: tuple[EvidenceModel, ...]

    def at(self, pose_error_m: float) -> EvidenceModel:
        """The level with the least pose error not below this one, metres.

        Raises
        ------
        CalibrationError
            If it was calibrated at none so large.
        """
        for level in self.levels:
            if level.pose_error_m >= pose_error_m:
                return level
        most = max((level.pose_error_m for level in self.levels), default=0.0)
        raise CalibrationError(f"calibrated up to a pose error of {most:g} m, {pose_error_m:g} m is asked for")

    def write(self, path: Path) -> None:
        """Write as JSON."""
        content = {
            "format": FORMAT,
            "detector": self.detector,
            "weights_digest": self.weights_digest,
            "recipe": dict(self.recipe),
            "levels": [
                {
                    "pose_error_m": level.pose_error_m,
                    "kinds": list(level.kinds),
                    "jaccard": _rounded(level.jaccard),
                    "pairs": _rounded(level.pairs),
                }
                for level in self.levels
            ],
        }
        path.write_text(json.dumps(content) + "\n")

    @classmethod
    def read(cls, path: Path) -> Calibration:
        """Read what `write` wrote.

        Raises
        ------
        CalibrationError
            If the file cannot be read or is no calibration.
        """
        try:
            content = json.loads(path.read_text())
            if content["format"] != FORMAT:
                raise CalibrationError(f"format {content['format']!r} is unknown")
            levels = [
                EvidenceModel(
                    float(level["pose_error_m"]),
                    tuple(map(str, level["kinds"])),
                    _normalised(level["jaccard"]),
                    _normalised(level["pairs"]),
                )
                for level in content["levels"]
            ]
            levels.sort(key=lambda level: level.pose_error_m)
            return cls(str(content["detector"]), str(content["weights_digest"]), content["recipe"], tuple(levels))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CalibrationError(f"{path} is no calibration: {error}") from error


def _rounded(table: FloatArray) -> Sequence[Any]:
    values: Sequence[Any] = np.round(table, 6).tolist()
    return values


def _normalised(values: Sequence[Any]) -> FloatArray:
    table = np.asarray(values, dtype=np.float64)
    total: FloatArray = table / table.sum(axis=-1, keepdims=True)
    return total
