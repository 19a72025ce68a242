"""Average precision of rotated BEV boxes, pooled over frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray, pairwise_iou


@dataclass(frozen=True)
class Matched:
    """A frame's detections, each with the true box that it overlaps most."""

    scores: FloatArray
    iou: FloatArray
    """(n,): the IoU with that box; 0 where there is none."""
    best: IntArray
    """(n,): its index; -1 where there is none."""
    truths: int
    """True boxes of the frame."""


def match(detections: FloatArray, truth: FloatArray) -> Matched:
    """Match a frame's detections (n, 6), with scores, to its true boxes (g, 5), in one frame of reference."""
    scores = np.array(detections[:, 5], dtype=np.float64)
    if not len(truth):
        return Matched(scores, np.zeros(len(scores)), np.full(len(scores), -1), 0)
    iou = pairwise_iou(detections, truth)
    best = iou.argmax(axis=1)
    return Matched(scores, iou[np.arange(len(iou)), best], best, len(truth))


class AveragePrecision:
    """Collects frames and computes average precision at any IoU threshold.

    Detections of all frames are pooled and taken by descending score. A detection looks only at the true box that it
    overlaps most; it is a true positive if that IoU reaches the threshold and the box is not taken yet, else a false
    positive. AP is the area under the precision envelope over recall. (This is the protocol of the published
    implementation, except that a frame without detections still counts with its true boxes; there it is dropped.)

    Examples
    --------
    >>> import numpy as np
    >>> ap = AveragePrecision()
    >>> ap.add(np.array([[0, 0, 4, 2, 0, 0.9]]), np.array([[0, 0, 4, 2, 0]]))
    >>> ap.at(0.5)
    1.0
    """

    def __init__(self) -> None:
        self._frames: list[Matched] = []
        self._groups: list[int] = []
        self._truths: Counter[int] = Counter()
        self._pool: _Pool | None = None

    @property
    def truths(self) -> int:
        """True boxes so far."""
        return self._truths.total()

    def add(self, detections: FloatArray, truth: FloatArray, group: int = 0) -> None:
        """Add a frame: detections (n, 6) with scores, true boxes (g, 5), in one frame of reference."""
        self.add_matched(match(detections, truth), group)

    def add_matched(self, frame: Matched, group: int = 0) -> None:
        """Add a frame that is matched already; ``group`` is what it can be left out with, as its sequence."""
        self._frames.append(frame)
        self._groups.append(group)
        self._truths[group] += frame.truths
        self._pool = None

    def at(self, iou_threshold: float) -> float:
        """Average precision in [0, 1] at an IoU threshold in (0, 1]; nan without any true box."""
        positive = self._pooled().positive(iou_threshold)
        return _area(np.flatnonzero(positive) + 1, self.truths)

    def leaving_out(self, *iou_thresholds: float) -> FloatArray:
        """Average precision without each group in turn: (thresholds, groups), ascending; nan without any true box."""
        pool = self._pooled()
        positives = [np.flatnonzero(pool.positive(threshold)) for threshold in iou_thresholds]
        groups = sorted(self._truths)
        areas = np.empty((len(positives), len(groups)))
        for column, group in enumerate(groups):
            kept = pool.groups != group
            rank = np.cumsum(kept)
            for line, positive in enumerate(positives):
                # a true box and all that is matched to it are of one group, so who is positive stays the same
                areas[line, column] = _area(rank[positive[kept[positive]]], self.truths - self._truths[group])
        return areas

    def curve(self, iou_threshold: float) -> tuple[FloatArray, FloatArray]:
        """Precision and recall after each detection, best score first.

        Raises
        ------
        ValueError
            If the threshold is not in (0, 1].
        """
        found = np.cumsum(self._pooled().positive(iou_threshold))
        return found / np.arange(1, len(found) + 1), found / max(self.truths, 1)

    def _pooled(self) -> _Pool:
        if self._pool is None:
            self._pool = _Pool.of(self._frames, self._groups)
        return self._pool


@dataclass(frozen=True)
class _Pool:
    """Detections of all frames, best score first; ``owner`` is the number of the true box among those of all frames."""

    iou: FloatArray
    owner: IntArray
    groups: IntArray

    @classmethod
    def of(cls, frames: list[Matched], groups: list[int]) -> _Pool:
        if not frames:
            return cls(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
        before = np.cumsum([0, *(frame.truths for frame in frames[:-1])])
        order = np.argsort(-np.concatenate([frame.scores for frame in frames]), kind="stable")
        owner = np.concatenate([frame.best + offset for frame, offset in zip(frames, before, strict=True)])
        group = np.repeat(np.array(groups, dtype=np.int64), [len(frame.scores) for frame in frames])
        return cls(np.concatenate([frame.iou for frame in frames])[order], owner[order], group[order])

    def positive(self, iou_threshold: float) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether each detection is a true positive."""
        if not 0.0 < iou_threshold <= 1.0:
            raise ValueError(f"iou_threshold must be in (0, 1], got {iou_threshold}")
        candidates = np.flatnonzero(self.iou >= iou_threshold)
        _, first = np.unique(self.owner[candidates], return_index=True)
        positive = np.zeros(len(self.iou), dtype=bool)
        positive[candidates[first]] = True
        return positive


def _area(ranks: IntArray, truths: int) -> float:
    """Area under the precision envelope: a step of 1 / truths in recall at the rank, from 1, of each true positive."""
    if truths == 0:
        return float("nan")
    precision = np.arange(1, len(ranks) + 1) / ranks
    return float(np.maximum.accumulate(precision[::-1]).sum() / truths)
