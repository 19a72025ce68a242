"""Average precision of rotated BEV boxes, pooled over frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from robosac.boxes import FloatArray, pairwise_iou


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
        self._scores: list[FloatArray] = []
        self._iou: list[FloatArray] = []
        self._best: list[np.ndarray[Any, np.dtype[np.int64]]] = []
        self._truths = 0

    @property
    def truths(self) -> int:
        """True boxes so far."""
        return self._truths

    def add(self, detections: FloatArray, truth: FloatArray) -> None:
        """Add a frame: detections (n, 6) with scores, true boxes (g, 5), in one frame of reference."""
        if len(detections):
            if len(truth):
                iou = pairwise_iou(detections, truth)
                best = iou.argmax(axis=1)
                self._iou.append(iou[np.arange(len(iou)), best])
                self._best.append(best + self._truths)
            else:
                self._iou.append(np.zeros(len(detections)))
                self._best.append(np.full(len(detections), -1))
            self._scores.append(np.asarray(detections[:, 5], dtype=np.float64))
        self._truths += len(truth)

    def at(self, iou_threshold: float) -> float:
        """Average precision in [0, 1] at an IoU threshold in (0, 1]; nan without any true box."""
        precision, recall = self.curve(iou_threshold)
        if self._truths == 0:
            return float("nan")
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return float(np.sum(np.diff(recall, prepend=0.0) * envelope))

    def curve(self, iou_threshold: float) -> tuple[FloatArray, FloatArray]:
        """Precision and recall after each detection, best score first.

        Raises
        ------
        ValueError
            If the threshold is not in (0, 1].
        """
        if not 0.0 < iou_threshold <= 1.0:
            raise ValueError(f"iou_threshold must be in (0, 1], got {iou_threshold}")
        if not self._scores:
            return np.empty(0), np.empty(0)
        order = np.argsort(-np.concatenate(self._scores), kind="stable")
        hit = np.concatenate(self._iou)[order] >= iou_threshold
        owner = np.concatenate(self._best)[order]
        candidates = np.flatnonzero(hit)
        _, first = np.unique(owner[candidates], return_index=True)
        positive = np.zeros(len(order))
        positive[candidates[first]] = 1.0
        found = np.cumsum(positive)
        return found / np.arange(1, len(order) + 1), found / max(self._truths, 1)
