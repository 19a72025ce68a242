"""From counted verdicts to likelihood tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import isotonic_regression

from robosac.boxes import FloatArray
from robosac.calibration.verdicts import Verdicts
from robosac.defenses.group_testing.model import (
    CELLS,
    JACCARD_BINS,
    JOINING_SIZES,
    LOSS_BINS,
    NOVELTY_BINS,
    OPEN,
    SIZES,
    WITNESS_SIZES,
    EvidenceModel,
)

EFFECTIVE_COUNT = 100.0
"""Pairs of a frame repeat each other: however many were counted, a histogram is worth no more than this many."""
PSEUDO_COUNT = 2.0
"""Counts of a uniform histogram that every other one is mixed with."""
UNIFORM_SHARE = 0.05
"""Share of a uniform histogram in those of attacked fusions, for what attackers may do otherwise."""
LARGEST_RATIO = 4.0
"""No single outcome says more than this, as a natural logarithm of a likelihood ratio."""
_KERNEL = (0.25, 0.5, 0.25)


class TooFewVerdicts(ValueError):
    """Something that the tables need was never observed."""


def fit(verdicts: Verdicts, kinds: Sequence[str], pose_error_m: float) -> EvidenceModel:
    """Smoothed histograms of what was observed.

    1. A histogram of attacked fusions, and of unattacked ones, is smoothed along each axis by [1/4 1/2 1/4], and mixed
       with a uniform one.
    2. The ratio of attacked to unattacked is kept within ``exp(+-4)``.
    3. Of the Jaccard index it is made not to rise with the index (isotonic regression): a fusion that agrees with the
       ego never incriminates, whatever attackers in the calibration did.
    4. The kind `OPEN` has a uniform histogram for every attacked fusion.

    Parameters
    ----------
    verdicts : Verdicts
    kinds : sequence of str
        Of the attacks in the verdicts, without `OPEN`.
    pose_error_m : float
        That the verdicts were observed with.

    Raises
    ------
    TooFewVerdicts
        If a kind, cell or size was never observed.
    """
    jaccard = np.zeros((2 + len(kinds), SIZES, JACCARD_BINS))
    for row, kind in enumerate([None, *kinds]):
        for size in range(SIZES):
            counts = [verdicts.jaccard[kind, size + 1, b] for b in range(JACCARD_BINS)]
            jaccard[row, size] = _density(np.array(counts, dtype=np.float64)[:, None], kind, f"size {size + 1}")
    jaccard[-1] = 1.0 / JACCARD_BINS
    pairs = np.zeros((1 + CELLS * (len(kinds) + 1), WITNESS_SIZES, JOINING_SIZES, LOSS_BINS * NOVELTY_BINS))
    rows = [(None, 0), *((kind, cell) for kind in kinds for cell in range(1, 1 + CELLS))]
    for row, (kind, cell) in enumerate(rows):
        for a in range(WITNESS_SIZES):
            for d in range(JOINING_SIZES):
                counts = [verdicts.pairs[kind, cell, a + 1, d + 1, b] for b in range(pairs.shape[-1])]
                grid = np.array(counts, dtype=np.float64).reshape(LOSS_BINS, NOVELTY_BINS)
                pairs[row, a, d] = _density(grid, kind, f"cell {cell}, sizes {a + 1} and {d + 1}")
    pairs[len(rows) :] = 1.0 / pairs.shape[-1]
    return EvidenceModel(
        pose_error_m,
        (*kinds, OPEN),
        np.concatenate([jaccard[:1], _bounded(jaccard[:1], jaccard[1:], falling=True)]),
        np.concatenate([pairs[:1], _bounded(pairs[:1], pairs[1:], falling=False)]),
    )


def _density(counts: FloatArray, kind: str | None, what: str) -> FloatArray:
    """A smoothed histogram (n * m,) from counts (n, m)."""
    total = counts.sum()
    if not total:
        raise TooFewVerdicts(f"no verdicts of {kind or 'honest teammates'}, {what}")
    smooth = counts / total
    for axis in range(2):
        if counts.shape[axis] > 1:
            smooth = _smoothed(smooth, axis)
    worth = min(total, EFFECTIVE_COUNT)
    density = (worth * smooth + PSEUDO_COUNT / counts.size) / (worth + PSEUDO_COUNT)
    if kind is not None:
        density = (1 - UNIFORM_SHARE) * density + UNIFORM_SHARE / counts.size
    flat: FloatArray = density.ravel() / density.sum()
    return flat


def _smoothed(histogram: FloatArray, axis: int) -> FloatArray:
    """By the kernel, what would leave at either end staying there."""
    padded = np.pad(histogram, [(1, 1) if i == axis else (0, 0) for i in range(2)], mode="edge")
    n = histogram.shape[axis]
    parts = [w * np.take(padded, range(i, i + n), axis=axis) for i, w in enumerate(_KERNEL)]
    total = np.sum(parts, axis=0)
    smooth: FloatArray = total / total.sum()
    return smooth


def _bounded(clean: FloatArray, attacked: FloatArray, *, falling: bool) -> FloatArray:
    """The attacked rows with their ratio to the clean one bounded and, if asked, made not to rise with the bin."""
    ratio = np.clip(np.log(attacked / clean), -LARGEST_RATIO, LARGEST_RATIO)
    if falling:
        for row, size in np.ndindex(ratio.shape[:2]):
            weight = (clean[0, size] + attacked[row, size]) / 2
            ratio[row, size] = isotonic_regression(ratio[row, size], weights=weight, increasing=False).x
    bounded = clean * np.exp(ratio)
    normal: FloatArray = bounded / bounded.sum(axis=-1, keepdims=True)
    return normal
