"""How the true boxes of answers stand: confirmed, contradicted, or neither."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robosac.boxes import FloatArray, pairwise_iou
from robosac.evaluation.objects import CONFIRMED, MATCH_IOU, Shown


class TrueBoxes(NamedTuple):
    """Counts of true boxes: those with an IoU >= .3 with a true box."""

    judged: int
    """All, the contradicted ones among them, whether they are left out of the answer or kept in."""
    confirmed: int
    contradicted: int


NONE = TrueBoxes(0, 0, 0)


def true_boxes(shown: Shown, truth: FloatArray) -> TrueBoxes:
    """Count those of one answer, given the true boxes (G, 5) of its frame; none if the defence does not know."""
    if shown.standing is None:
        return NONE
    status = np.array(shown.standing, dtype=object)[_are_true(shown.boxes, truth)]
    contradicted = int(_are_true(shown.contradicted, truth).sum())
    return TrueBoxes(len(status) + contradicted, int((status == CONFIRMED).sum()), contradicted)


def _are_true(boxes: FloatArray, truth: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    overlap = pairwise_iou(boxes, truth).max(axis=1, initial=0.0)
    return np.asarray(overlap >= MATCH_IOU)
