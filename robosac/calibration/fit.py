"""From counted verdicts to likelihood tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import isotonic_regression

from robosac.boxes import FloatArray
from robosac.calibration.verdicts import Verdicts
from robosac.defenses.group_testing.model import (
    BINS,
    CELLS,
    CHANGE_BINS,
    CHANGE_SIZES,
    CLEAN,
    CROWD_BINS,
    LOSS_BINS,
    NOVELTY_BINS,
    OPEN,
    SIZES,
    EvidenceModel,
)

EFFECTIVE_COUNT = 100.0
"""Pairs of a frame repeat each other: however many were counted, a histogram is worth no more than this many."""
PSEUDO_COUNT = 2.0
"""Counts of a uniform histogram that every other one is mixed with."""
UNIFORM_SHARE = 0.05
"""Share of a uniform histogram in those of attacked fusions, for what attackers may do otherwise."""
PROJECTIONS = 50
"""Rounds of alternating projections."""
LARGEST_RATIO = 4.0
"""Logarithms of likelihood ratios are clipped here, before the rows are made to sum to 1 again."""
LARGEST_CHANGE_RATIO = 3.0
"""Those of comparisons with the frame before, which are made again and again, are clipped here."""
_FEW = 1e-12
_WHERE = ("", ", attackers among the joining", ", attackers among the joined", ", attackers among both")
_KERNEL = (0.25, 0.5, 0.25)


class TooFewVerdicts(ValueError):
    """Something that the tables need was never observed."""


def fit(verdicts: Verdicts, kinds: Sequence[str], pose_error_m: float) -> EvidenceModel:
    """Smoothed histograms of what was observed.

    1. A histogram of attacked fusions, and of unattacked ones, is smoothed along each axis by [1/4 1/2 1/4], and mixed
       with a uniform one.
    2. The ratio of attacked to unattacked is clipped to ``exp(+-4)``.
    3. Beside the ego alone it is made not to fall with loss or novelty (isotonic regression): a fusion that agrees with
       the ego never incriminates, whatever attackers in the calibration did.
    4. The kind `OPEN` has a uniform histogram for every attacked pair.
    5. Where nobody was complementary, the histogram of all unattacked pairs stands.
    6. Fusions that are larger than the largest team that was observed have the histograms of the largest fusions.
    7. Of boxes that come and go there is a histogram for each number of boxes, smoothed over the neighbouring numbers.
       Its ratio is clipped to ``exp(+-3)`` and made not to fall with the changes, and `OPEN` shows what nobody's
       attack shows: an attacker that is not among the kinds may well hold its boxes.

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
        If a kind, a cell of it, or a size was never observed.
    """
    rows = [(None, cell) for cell in range(CLEAN)] + [(kind, cell) for kind in kinds for cell in range(1, 1 + CELLS)]
    pairs = np.full((len(rows) + CELLS, len(SIZES), BINS), 1.0 / BINS)
    missing = []
    for row, (kind, cell) in enumerate(rows):
        for size in range(len(SIZES)):
            shown = _largest_shown(size, verdicts.team)
            a, d = SIZES[shown]
            seen = cell if a else min(cell, 1)  # nobody is in the ego alone, to attack
            counts = np.array([verdicts.pairs[kind, seen, shown, b] for b in range(BINS)], dtype=np.float64)
            if counts.any():
                pairs[row, size] = _density(counts.reshape(LOSS_BINS, NOVELTY_BINS), kind)
            elif kind is None and cell:  # nobody was complementary
                pairs[row, size] = pairs[0, size]
            elif shown == size:
                missing.append(f"{kind or 'no attack'}: {d} joining {a}{_WHERE[seen]}")
    clean, *attacked = (_change_density(verdicts, kind, missing) for kind in (None, *kinds))
    if missing:
        raise TooFewVerdicts(f"never observed: {'; '.join(missing[:3])}{'; and more' if len(missing) > 3 else ''}")
    bounded = _bounded(pairs[:1], pairs[CLEAN:])
    changes = [_change_ratio_bounded(clean, density) for density in attacked]
    return EvidenceModel(
        pose_error_m, (*kinds, OPEN), np.concatenate([pairs[:CLEAN], bounded]), np.stack([clean, *changes, clean])
    )


def _largest_shown(size: int, team: int) -> int:
    """The row of `SIZES` that stands for a row in a team of this size."""
    a, d = SIZES[size]
    a = min(a, max(team, 1) - 1)
    return SIZES.index((a, min(d, max(team - a, 1))))


def _change_density(verdicts: Verdicts, kind: str | None, missing: list[str]) -> FloatArray:
    """Histograms (CHANGE_SIZES, CROWD_BINS, CHANGE_BINS), each last axis by itself; what is ``missing`` is added."""
    counts = np.zeros((CHANGE_SIZES, CROWD_BINS, CHANGE_BINS))
    for size, crowd, change in np.ndindex(counts.shape):
        counts[size, crowd, change] = verdicts.changes[kind, max(0, min(size, verdicts.team - 1)), crowd, change]
    unseen = [size for size, counted in enumerate(counts.sum(axis=(1, 2)), start=1) if not counted]
    missing += [f"{kind or 'no attack'}: {size} in successive frames" for size in unseen]
    padded = np.pad(counts, [(0, 0), (1, 1), (0, 0)], mode="edge")
    smooth = np.sum([w * padded[:, i : i + CROWD_BINS] for i, w in enumerate(_KERNEL)], axis=0)
    total = smooth.sum(axis=-1, keepdims=True)
    worth = np.minimum(total, EFFECTIVE_COUNT)
    uniform = 1.0 / CHANGE_BINS
    density = (worth * smooth / np.maximum(total, _FEW) + PSEUDO_COUNT * uniform) / (worth + PSEUDO_COUNT)
    if kind is not None:
        density = (1 - UNIFORM_SHARE) * density + UNIFORM_SHARE * uniform
    return _normal(density)


def _normal(rows: FloatArray) -> FloatArray:
    """Rows (..., n) that each sum to 1."""
    normal: FloatArray = rows / rows.sum(axis=-1, keepdims=True)
    return normal


def _change_ratio_bounded(clean: FloatArray, attacked: FloatArray) -> FloatArray:
    ratio = np.clip(np.log(attacked / clean), -LARGEST_CHANGE_RATIO, LARGEST_CHANGE_RATIO)
    for index in np.ndindex(ratio.shape[:2]):
        ratio[index] = isotonic_regression(ratio[index], weights=(clean[index] + attacked[index]) / 2).x
    return _normal(clean * np.exp(ratio))


def _density(counts: FloatArray, kind: str | None) -> FloatArray:
    """A smoothed histogram (n * m,) from counts (n, m)."""
    total = counts.sum()
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


def _bounded(clean: FloatArray, attacked: FloatArray) -> FloatArray:
    """The attacked rows with their ratio to the clean one bounded and, beside the ego alone, made not to fall with loss
    and novelty.
    """
    ratio = np.clip(np.log(attacked / clean), -LARGEST_RATIO, LARGEST_RATIO)
    weight = (clean + attacked) / 2
    for row, size in np.ndindex(ratio.shape[:2]):
        if SIZES[size][0] == 0:
            ratio[row, size] = _rising(ratio[row, size], weight[row, size])
    return _normal(clean * np.exp(ratio))


def _rising(values: FloatArray, weights: FloatArray) -> FloatArray:
    """The closest grid (weighted least squares) that falls neither with loss nor with novelty, by Dykstra's
    alternating projections.
    """
    grid, weight = values.reshape(LOSS_BINS, NOVELTY_BINS), weights.reshape(LOSS_BINS, NOVELTY_BINS)
    owed = [np.zeros_like(grid), np.zeros_like(grid)]
    for _ in range(PROJECTIONS):
        for axis in range(2):
            before = grid + owed[axis]
            lines = zip(np.moveaxis(before, axis, -1), np.moveaxis(weight, axis, -1), strict=True)
            grid = np.moveaxis(np.array([isotonic_regression(x, weights=w).x for x, w in lines]), -1, axis)
            owed[axis] = before - grid
    flat: FloatArray = grid.ravel()
    return flat
