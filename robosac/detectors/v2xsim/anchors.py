"""Anchors of the V2X-Sim detector: from logits and codes to boxes.

Every cell of a 256 x 256 map (0.25 m) has six anchors: 2 x 4 m and 3 x 12 m (w x h), each at three angles. Anchors and
codes live in the *anchor frame*, whose x is minus the LiDAR's x; its y is the LiDAR's. A box there is x, y, w, h, sin,
cos: its corners (+-w/2, +-h/2) are turned by ``x' = cos x + sin y``, ``y' = -sin x + cos y`` before x, y is added. Sin
and cos come from a regression and need not have the norm 1, so the norm scales the box.

Source of layout, decoding and thresholds: the published implementation (coperception/ROBOSAC, revision 4642aa2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch

from robosac.boxes import FloatArray, IntArray, nms
from robosac.detectors.recorded import Tensors
from robosac.detectors.suppression import LOOKED_AT, Picked, brought_back, suppressed
from robosac.detectors.v2xsim.network import ANCHORS, GRID
from robosac.detectors.v2xsim.voxels import AREA_M, CELL_M

SCORE_THRESHOLD = 0.7
"""Softmax score of the vehicle class; a detection scores more than this."""
NMS_IOU = 0.01
MAX_CANDIDATES = 1000
"""Best anchors that are decoded: bounds the work that a flooded frame (393,216 candidates) can cause."""
MAX_LOG_SIZE = 8.0
"""Bound on the codes of w and h, so that no message makes a box of infinite size."""

_LEAST_SQUARE = 1e-12
_SIZES_M = ((2.0, 4.0), (3.0, 12.0))
_ANGLES = (0.0, math.pi / 2, -math.pi / 4)
_SHAPES = np.array([[w, h, math.sin(a), math.cos(a)] for w, h in _SIZES_M for a in _ANGLES])


def anchor_boxes(index: IntArray) -> FloatArray:
    """Anchors of the given numbers.

    Parameters
    ----------
    index : (n,) int64 ndarray
        ``(row * 256 + column) * 6 + k``.

    Returns
    -------
    (n, 6) float64 ndarray
        x, y, w, h, sin, cos; anchor frame, metres.
    """
    cell, k = np.divmod(np.asarray(index), ANCHORS)
    row, column = np.divmod(cell, GRID)
    centre = -AREA_M + CELL_M * (np.column_stack([column, row]) + 0.5)
    return np.hstack([centre, _SHAPES[k]])


def decode(anchors: FloatArray, codes: FloatArray) -> FloatArray:
    """Boxes that codes make of anchors.

    ``w = w_a / exp(w_p)``, ``h = h_a / exp(h_p)``, ``x = x_a - w x_p``, ``y = y_a - h y_p``; sin and cos of the sum of
    both angles, by the addition theorem.

    Parameters
    ----------
    anchors : (n, 6) ndarray
        As `anchor_boxes` returns them.
    codes : (n, 6) ndarray
        ``x_p, y_p, w_p, h_p, sin_p, cos_p``; the sizes are cut at +-8.

    Returns
    -------
    (n, 6) float64 ndarray
        x, y, w, h, sin, cos; anchor frame, metres.
    """
    codes = np.asarray(codes, dtype=np.float64)
    size = anchors[:, 2:4] * np.exp(-np.clip(codes[:, 2:4], -MAX_LOG_SIZE, MAX_LOG_SIZE))
    centre = anchors[:, :2] - size * codes[:, :2]
    sin_a, cos_a, sin_p, cos_p = anchors[:, 4], anchors[:, 5], codes[:, 4], codes[:, 5]
    sine, cosine = sin_a * cos_p + cos_a * sin_p, cos_a * cos_p - sin_a * sin_p
    return np.column_stack([centre, size, sine, cosine])


def to_lidar(boxes: FloatArray) -> FloatArray:
    """Boxes (n, 6) of the anchor frame as x, y, length, width, yaw (n, 5) in the LiDAR's; length is h."""
    x, y, w, h, sine, cosine = boxes.T
    norm = np.hypot(sine, cosine)
    return np.column_stack([-x, y, h * norm, w * norm, np.arctan2(cosine, -sine)])


def geometry(codes: torch.Tensor, anchors: torch.Tensor | None = None) -> torch.Tensor:
    """The boxes of anchors as an attacker sees them, differentiable.

    Parameters
    ----------
    codes : (n, 6) tensor
    anchors : (n, 6) tensor, optional
        By default all 393216.

    Returns
    -------
    (n, 6) tensor
        x, y, log length, log width, cos and sin of twice the yaw, of the box that `decode` and `to_lidar` make.
    """
    anchors = _all_anchors(codes.device) if anchors is None else anchors
    log_size = anchors[:, 2:4].log() - codes[:, 2:4].clamp(-MAX_LOG_SIZE, MAX_LOG_SIZE)
    centre = anchors[:, :2] - log_size.exp() * codes[:, :2]
    sin_a, cos_a, sin_p, cos_p = anchors[:, 4], anchors[:, 5], codes[:, 4], codes[:, 5]
    sine, cosine = sin_a * cos_p + cos_a * sin_p, cos_a * cos_p - sin_a * sin_p
    square = (sine.square() + cosine.square()).clamp(min=_LEAST_SQUARE)
    log_norm = square.log() / 2
    columns = (
        -centre[:, 0],
        centre[:, 1],
        log_size[:, 1] + log_norm,
        log_size[:, 0] + log_norm,
        (sine.square() - cosine.square()) / square,
        -2 * sine * cosine / square,
    )
    return torch.stack(columns, dim=1)


@lru_cache(maxsize=4)
def _all_anchors(device: torch.device) -> torch.Tensor:
    """Every anchor, (393216, 6), float32."""
    with torch.inference_mode(False):  # whoever wants gradients may use them later
        return torch.from_numpy(anchor_boxes(np.arange(GRID * GRID * ANCHORS))).float().to(device)


class Indexed(Protocol):
    """What has codes by anchor: a tensor (A, 6), or what computes them once they are asked for."""

    def __getitem__(self, anchors: torch.Tensor, /) -> torch.Tensor:
        """The codes (n, 6), float32, of anchors (n,)."""


def detections(
    logits: torch.Tensor, codes: Indexed, score_threshold: float = SCORE_THRESHOLD
) -> tuple[FloatArray, IntArray]:
    """As `detections_of_each`, of one map: logits (A,)."""
    return detections_of_each(logits[None], codes, score_threshold)[0]


def detections_of_each(
    logits: torch.Tensor, codes: Indexed, score_threshold: float = SCORE_THRESHOLD
) -> list[tuple[FloatArray, IntArray]]:
    """Boxes of one ego, of each map.

    1. An anchor is a candidate if its softmax score exceeds the threshold t, that is if its logit exceeds
       ``ln(t / (1 - t))``; of more than 1000 the best are kept.
    2. Candidates are decoded, and by descending score each suppresses what overlaps it at an IoU above 0.01.

    Parameters
    ----------
    logits : (n, A) float32 tensor
        Difference of the logits of vehicle and background.
    codes : (n A, 6) float32 tensor, or `Indexed`
        Only those of candidates are looked at.
    score_threshold : float
        Strictly between 0 and 1.

    Returns
    -------
    boxes : (n, 6) float64 ndarray
        x, y, length, width, yaw, score; LiDAR frame, best first.
    anchor : (n,) int64 ndarray
        The anchor that each comes from.
    """
    return [_kept(*candidates) for candidates in picked(logits, codes, _floor(score_threshold))]


def found_there(logits: torch.Tensor, codes: Indexed, score_threshold: float = SCORE_THRESHOLD) -> Tensors:
    """As `detections_of_each`, on an accelerator; `detections_there` makes boxes of it."""
    margin, index, code = best_anchors(logits, codes, _floor(score_threshold))
    margin = torch.where(code.isfinite().all(2), margin, -torch.inf)
    looked_at = index[:, :LOOKED_AT]
    anchors = _all_anchors(index.device)[looked_at.flatten()]
    x, y, log_length, log_width, cosine, sine = geometry(code[:, :LOOKED_AT].flatten(0, 1), anchors).unbind(1)
    boxes = torch.stack([x, y, log_length.exp(), log_width.exp(), torch.atan2(sine, cosine) / 2], 1)
    return suppressed(margin, index, code, boxes.view(*looked_at.shape, -1), NMS_IOU)


def detections_there(found: Tensors) -> list[FloatArray]:
    """The boxes of each map, of what `found_there` returns; they are made on the processor."""
    parts = list(brought_back(*found))
    done = [picked for picked, is_done in parts if is_done]
    boxes: Iterator[FloatArray] = iter(())
    if done:
        ends = np.cumsum([len(index) for index, _, _ in done])[:-1]
        boxes = iter(np.split(_boxes(*map(np.concatenate, zip(*done, strict=True))), ends))
    return [next(boxes) if is_done else _kept(*picked)[0] for picked, is_done in parts]


def _floor(score_threshold: float) -> float:
    """The logit that has this score."""
    return math.log(score_threshold / (1 - score_threshold))


def _kept(index: IntArray, margin: FloatArray, code: FloatArray) -> tuple[FloatArray, IntArray]:
    sound = np.isfinite(code).all(axis=1)  # a message of enormous numbers may overflow single precision
    index, margin, code = index[sound], margin[sound], code[sound]
    boxes = _boxes(index, margin, code)
    kept = nms(boxes, margin, NMS_IOU)
    return boxes[kept], index[kept]


def _boxes(index: IntArray, margin: FloatArray, code: FloatArray) -> FloatArray:
    score = 1 / (1 + np.exp(-margin.astype(np.float64)))
    return np.column_stack([to_lidar(decode(anchor_boxes(index), code)), score])


def picked(logits: torch.Tensor, codes: Indexed, floor: float) -> Iterator[Picked]:
    """The candidates of each map, on the processor: `best_anchors` takes several times as long there."""
    for i, margin in enumerate(logits.numpy()):
        index: IntArray = np.flatnonzero(margin > floor)
        if len(index) > MAX_CANDIDATES:
            index = np.sort(index[np.argpartition(-margin[index], MAX_CANDIDATES)[:MAX_CANDIDATES]])
        yield index, margin[index], codes[torch.from_numpy(index + i * len(margin))].numpy()


def best_anchors(logits: torch.Tensor, codes: Indexed, floor: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The best `MAX_CANDIDATES` anchors of each map, whether they are candidates or not.

    So the shapes do not depend on what is seen, and nothing has to wait for it.

    Returns
    -------
    logits : (n, k) tensor
        Minus infinity where an anchor is no candidate.
    index : (n, k) tensor
    codes : (n, k, 6) tensor
    """
    best, index = torch.where(logits > floor, logits, -torch.inf).topk(MAX_CANDIDATES)
    before = logits.shape[1] * torch.arange(len(logits), device=logits.device)
    return best, index, codes[(index + before[:, None]).flatten()].reshape(*index.shape, -1)
