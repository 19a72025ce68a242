"""The consensus test: whether two perceptions of one scene agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from robosac.answers import Verdict
from robosac.boxes import BoolArray, FloatArray, IntArray, as_boxes, pairwise_iou

MATCH_IOU = 0.5
DEFAULT_THRESHOLD = 0.3


@dataclass(frozen=True)
class Comparison:
    """Result of a consensus test."""

    jaccard_index: float
    """Matched pairs over all distinct boxes, in [0, 1]; 1 for two empty sets."""
    matched: int
    """Pairs matched one to one at IoU 0.5 or more."""
    verdict: Verdict


def at_least(boxes: FloatArray, score: float) -> FloatArray:
    """Boxes (n, 6) with this score or more: those that take part in the test."""
    boxes = as_boxes(boxes, columns=6)
    return boxes[boxes[:, 5] >= score]


def match(
    reference: FloatArray, candidate: FloatArray, iou_threshold: float = MATCH_IOU, iou: FloatArray | None = None
) -> tuple[IntArray, IntArray]:
    """Match boxes one to one.

    Where the pairs at or above the threshold are one to one already, they are the matching. Otherwise the total IoU of
    all pairs is maximised (Hungarian method) and the pairs below the threshold are dropped, so that in a dense cluster
    fewer pairs may remain than a largest matching would have. The published implementation does the same, and its
    answers are the ones that thresholds in the literature refer to.

    Parameters
    ----------
    reference : (n, 5+) ndarray
    candidate : (m, 5+) ndarray
        Boxes in the same frame.
    iou_threshold : float
        A pair counts from this IoU on; in (0, 1].
    iou : (n, m) ndarray, optional
        Of all pairs, where it is known already; by default it is computed.

    Returns
    -------
    rows, columns : (k,) int64 ndarray
        Indices of the matched pairs.
    """
    _check_unit("iou_threshold", iou_threshold)
    reference, candidate = as_boxes(reference, "reference"), as_boxes(candidate, "candidate")
    if iou is None:
        iou = pairwise_iou(reference, candidate)
    rows, columns = np.nonzero(iou >= iou_threshold)
    if all(len(set(each.tolist())) == len(each) for each in (rows, columns)):
        return rows, columns
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 (a second to import; `fuse` has it already)

    rows, columns = linear_sum_assignment(iou, maximize=True)
    kept = iou[rows, columns] >= iou_threshold
    return rows[kept], columns[kept]


def compare(
    reference: FloatArray,
    candidate: FloatArray,
    threshold: float = DEFAULT_THRESHOLD,
    known: Callable[[FloatArray], BoolArray] | None = None,
    iou: FloatArray | None = None,
) -> Comparison:
    """Compare a candidate perception with a reference.

    ``jaccard_index = matched / (n + m - matched)``; consensus if it reaches the threshold. (The paper writes a
    *difference* that must not exceed its threshold; its experiments accept when this similarity reaches 0.3.) One empty
    set against a non-empty one has index 0. Two empty sets have index 1 and are no evidence.

    Parameters
    ----------
    reference : (n, 5+) ndarray
    candidate : (m, 5+) ndarray
        Boxes in the same frame.
    threshold : float
        In (0, 1].
    known : callable, optional
        Of places (k, 2), of which the reference knows whether anything is there. Where there would be no consensus,
        candidates that match nothing count only if they are in such places: whoever sees little is no judge of the
        rest. By default all places are known.
    iou : (n, m) ndarray, optional
        As `match` takes it.
    """
    _check_unit("threshold", threshold)
    reference, candidate = as_boxes(reference, "reference"), as_boxes(candidate, "candidate")
    if len(reference) == 0 and len(candidate) == 0:
        return Comparison(1.0, 0, Verdict.NO_EVIDENCE)
    pairs = match(reference, candidate, iou=iou)[1]
    matched, others = len(pairs), len(candidate) - len(pairs)
    index = matched / (len(reference) + others)
    if matched and index < threshold and known is not None:
        others = int(np.count_nonzero(known(np.delete(candidate[:, :2], pairs, axis=0))))
        index = matched / (len(reference) + others)
    return Comparison(index, matched, Verdict.CONSENSUS if index >= threshold else Verdict.DISSENSUS)


def overlaps(reference: FloatArray, candidates: Sequence[FloatArray]) -> list[FloatArray]:
    """The IoU (n, m) of a reference's boxes with those of each of several candidates, as `match` takes it.

    All at once it takes little longer than one.
    """
    ends = np.cumsum([len(boxes) for boxes in candidates])[:-1]
    return np.split(pairwise_iou(reference, np.concatenate(candidates)), ends, axis=1)


def _check_unit(name: str, value: float) -> None:
    if not 0 < value <= 1:
        raise ValueError(f"{name} must be in (0, 1], got {value}")
