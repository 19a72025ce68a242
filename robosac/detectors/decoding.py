"""From the heads of the embedded detector to boxes, and from boxes to the codes that the heads learn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray, IntArray, nms
from robosac.detectors.network import HEAD
from robosac.detectors.recorded import Tensors
from robosac.detectors.suppression import LOOKED_AT, Picked, brought_back, suppressed
from robosac.detectors.voxels import AREA_M

HEAD_CELL_M = 2 * AREA_M / HEAD
OWN_BODY_M = 2.0
"""A detection centred this close to the sensor is the ego itself, as its teammates see it."""
MAX_PEAKS = 200
"""Candidates before suppression: bounds the work that a flooded frame can cause."""
NMS_IOU = 0.1
LOG_SIZES = -2.0, 4.0
"""Bounds on the codes of length and width."""


@lru_cache(maxsize=1)
def cell_centres() -> tuple[FloatArray, FloatArray]:
    """Centres of the head's cells: x and y (64, 64), ego frame, metres."""
    axis = -AREA_M + HEAD_CELL_M * (np.arange(HEAD) + 0.5)
    ys, xs = np.meshgrid(axis, axis, indexing="ij")
    return xs, ys


def box_codes(box: FloatArray, xs: FloatArray, ys: FloatArray) -> FloatArray:
    """Codes (6, n) of one box (5,) as seen from cells with these centres (n,)."""
    n = len(xs)
    constant = [np.log(box[2]), np.log(box[3]), np.cos(2 * box[4]), np.sin(2 * box[4])]
    return np.stack([box[0] - xs, box[1] - ys, *(np.full(n, value) for value in constant)])


def decode_boxes(logits: torch.Tensor, codes: torch.Tensor, score_threshold: float) -> FloatArray:
    """As `decode_all`, of one map: logits (64, 64) and codes (6, 64, 64)."""
    return decode_all(logits[None], codes[None], score_threshold)[0]


def decode_all(logits: torch.Tensor, codes: torch.Tensor, score_threshold: float) -> list[FloatArray]:
    """Boxes of one ego, of each map.

    1. Candidates are the peaks of the heatmap (3 x 3 maxima) from the score threshold on, at most 200 of the best.
    2. Of their boxes those remain that are centred within the area and not on the ego itself.
    3. Non-maximum suppression at IoU 0.1 is greedy. The yaw is known up to half a turn.

    Parameters
    ----------
    logits : (n, 64, 64) float32 tensor
    codes : (n, 6, 64, 64) float32 tensor
    score_threshold : float

    Returns
    -------
    list of (k, 6) float64 ndarray
        x, y, length, width, yaw, score; best first.
    """
    return [_kept(*candidates) for candidates in picked(logits, codes, _floor(score_threshold))]


def found_there(logits: torch.Tensor, codes: torch.Tensor, score_threshold: float) -> Tensors:
    """As `decode_all`, on an accelerator; `boxes_there` makes boxes of it."""
    value, index, code = best_peaks(logits, codes, _floor(score_threshold))
    x, y = code[..., 0] + _axis(index % HEAD), code[..., 1] + _axis(index // HEAD)
    within = (torch.hypot(x, y) >= OWN_BODY_M) & (x.abs() <= AREA_M) & (y.abs() <= AREA_M)
    length, width = code[..., 2:4].clip(*LOG_SIZES).exp().unbind(-1)
    boxes = torch.stack([x, y, length, width, torch.atan2(code[..., 5], code[..., 4]) / 2], -1)
    return suppressed(torch.where(within, value, -torch.inf), index, code, boxes[:, :LOOKED_AT], NMS_IOU)


def boxes_there(found: Tensors) -> list[FloatArray]:
    """The boxes of each map, of what `found_there` returns; they are made on the processor."""
    return [_boxes(*picked) if done else _kept(*picked) for picked, done in brought_back(*found)]


def _axis(cells: torch.Tensor) -> torch.Tensor:
    """Where the centres of rows or columns are, metres."""
    return HEAD_CELL_M * (cells + 0.5) - AREA_M


def _floor(score_threshold: float) -> float:
    """The logit that has this score."""
    return float(np.log(score_threshold / (1 - score_threshold)))


def peaks(logits: torch.Tensor, floor: float) -> torch.Tensor:
    """Which cells (n, 64, 64) are candidates."""
    return (functional.max_pool2d(logits, 3, stride=1, padding=1) == logits) & (logits >= floor)


def picked(logits: torch.Tensor, codes: torch.Tensor, floor: float) -> Iterator[Picked]:
    """The candidates of each map, on the processor: `best_peaks` takes longer there."""
    for candidate, value, code in zip(peaks(logits, floor).numpy(), logits.numpy(), codes.numpy(), strict=True):
        index = np.flatnonzero(candidate)
        if len(index) > MAX_PEAKS:
            index = index[np.argpartition(-value.flat[index].astype(np.float64), MAX_PEAKS)[:MAX_PEAKS]]
        row, column = np.divmod(index, HEAD)
        yield index, value[row, column], code[:, row, column].T


def best_peaks(
    logits: torch.Tensor, codes: torch.Tensor, floor: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The best `MAX_PEAKS` cells of each map, whether they are candidates or not.

    So the shapes do not depend on what is seen, and nothing has to wait for it.

    Returns
    -------
    logits : (n, k) tensor
        Minus infinity where a cell is no candidate.
    index : (n, k) tensor
    codes : (n, k, 6) tensor
    """
    best, index = torch.where(peaks(logits, floor), logits, -torch.inf).flatten(1).topk(MAX_PEAKS)
    return best, index, codes.flatten(2).gather(2, index[:, None].expand(-1, codes.shape[1], -1)).mT


def _kept(index: IntArray, values: FloatArray, codes: FloatArray) -> FloatArray:
    boxes = _boxes(index, values, codes)
    inside = (np.hypot(boxes[:, 0], boxes[:, 1]) >= OWN_BODY_M) & (np.abs(boxes[:, :2]) <= AREA_M).all(axis=1)
    boxes = boxes[inside]
    kept: FloatArray = boxes[nms(boxes, boxes[:, 5], NMS_IOU)]
    return kept


def _boxes(index: IntArray, values: FloatArray, codes: FloatArray) -> FloatArray:
    values, code = values.astype(np.float64), codes.T.astype(np.float64)
    row, column = np.divmod(index, HEAD)
    xs, ys = cell_centres()
    size = np.exp(np.clip(code[2:4], *LOG_SIZES))
    return np.column_stack(
        [
            xs[row, column] + code[0],
            ys[row, column] + code[1],
            size[0],
            size[1],
            np.arctan2(code[5], code[4]) / 2,
            1 / (1 + np.exp(-np.clip(values, -60.0, 60.0))),
        ]
    )
