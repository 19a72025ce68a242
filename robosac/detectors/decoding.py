"""From the heads of the embedded detector to boxes, and from boxes to the codes that the heads learn."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray, nms
from robosac.detectors.network import HEAD
from robosac.detectors.voxels import AREA_M

HEAD_CELL_M = 2 * AREA_M / HEAD
OWN_BODY_M = 2.0
"""A detection centred this close to the sensor is the ego itself, as its teammates see it."""
MAX_PEAKS = 200
"""Candidates before suppression: bounds the work that a flooded frame can cause."""
NMS_IOU = 0.1


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
    """Boxes of one ego.

    1. Candidates are the peaks of the heatmap (3 x 3 maxima) from the score threshold on, at most 200 of the best.
    2. Of their boxes those remain that are centred within the area and not on the ego itself.
    3. Non-maximum suppression at IoU 0.1 is greedy. The yaw is known up to half a turn.

    Parameters
    ----------
    logits : (64, 64) tensor
    codes : (6, 64, 64) tensor
    score_threshold : float

    Returns
    -------
    (n, 6) float64 ndarray
        x, y, length, width, yaw, score; best first.
    """
    peak = functional.max_pool2d(logits[None], 3, stride=1, padding=1)[0] == logits
    floor = float(np.log(score_threshold / (1 - score_threshold)))
    candidate = (peak & (logits >= floor)).numpy()
    xs, ys = cell_centres()
    row, column = np.nonzero(candidate)
    values = logits.numpy()[row, column].astype(np.float64)
    if len(values) > MAX_PEAKS:
        best = np.argpartition(-values, MAX_PEAKS)[:MAX_PEAKS]
        row, column, values = row[best], column[best], values[best]
    code = codes.numpy()[:, row, column].astype(np.float64)
    size = np.exp(np.clip(code[2:4], -2.0, 4.0))
    boxes = np.column_stack(
        [
            xs[row, column] + code[0],
            ys[row, column] + code[1],
            size[0],
            size[1],
            np.arctan2(code[5], code[4]) / 2,
            1 / (1 + np.exp(-np.clip(values, -60.0, 60.0))),
        ]
    )
    inside = (np.hypot(boxes[:, 0], boxes[:, 1]) >= OWN_BODY_M) & (np.abs(boxes[:, :2]) <= AREA_M).all(axis=1)
    boxes = boxes[inside]
    kept: FloatArray = boxes[nms(boxes, boxes[:, 5], NMS_IOU)]
    return kept
