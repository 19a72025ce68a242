"""Rotated boxes seen from above (bird's eye view): geometry, intersection over union, non-maximum suppression.

A box is ``x, y, length, width, yaw``: centre and sides in metres, yaw in radians counter-clockwise from +x to the box's
length. Further columns (a score) may follow and are ignored by the geometry. The frame is the caller's, and is the same
for both arguments wherever two sets of boxes meet. Lists of numbers will do for arrays; what has another shape is a
`ValueError` that names the argument.
"""

from __future__ import annotations

from operator import mul
from typing import Any

import numpy as np

FloatArray = np.ndarray[tuple[Any, ...], np.dtype[np.floating[Any]]]
IntArray = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]

RIGID_TOLERANCE = 1e-3
MIN_UPRIGHT = 0.5
"""Cosine of the largest tilt of a sensor; views from above mean nothing beyond it."""
MAX_TRANSLATION_M = 1e8
"""Farther than any earth-fixed frame needs; beyond it single precision would lose the warp."""
_LAST_ROW, _LAST_ONE = 1e-9, 1e-5
"""By how much the zeros and the one of a transform's last row may be off."""
_UNIT_CORNERS = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
_CLOSED = _UNIT_CORNERS[[0, 1, 2, 3, 0]]
_NMS_BLOCK = 64
_AT_A_TIME = 2**16
MOST_BOXES = 2**13
"""Of a detector in a frame: several times what those that ship can give."""


def as_boxes(boxes: Any, name: str = "boxes", columns: int = 5) -> FloatArray:
    """Boxes as a float64 array (n, 5+); an empty list is no box.

    Parameters
    ----------
    boxes : (n, 5+) array_like
    name : str
        The argument's, for the error.
    columns : int
        As many at least.

    Raises
    ------
    ValueError
        If they are not numbers of that shape.
    """
    try:
        array: FloatArray = np.asarray(boxes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers of shape (n, {columns}+): {error}") from error
    if array.shape == (0,):
        return np.empty((0, columns))
    if array.ndim != 2 or array.shape[1] < columns:
        raise ValueError(f"{name} must be of shape (n, {columns}+), got {array.shape}")
    return array


def as_pose(pose: Any) -> FloatArray:
    """A pose as a float64 array (4, 4); `ValueError` if it is none. What else a pose has to be, `pose_fault` says."""
    try:
        matrix: FloatArray = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"pose must be numbers of shape (4, 4): {error}") from error
    if matrix.shape != (4, 4):
        raise ValueError(f"pose must be of shape (4, 4), got {matrix.shape}")
    return matrix


def pose_matrix(x: float, y: float, z: float, yaw: float) -> FloatArray:
    """The rigid transform ``world_from_sensor`` (4, 4) of a sensor at (x, y, z) metres, turned by yaw about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def pose_fault(pose: FloatArray) -> str | None:
    """Why a matrix (4, 4) can be no sensor's pose; None if it can. What is no number makes it none.

    By plain numbers, which takes a tenth of what it takes with arrays: each message of each frame is checked.
    """
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = as_pose(pose).tolist()
    rows = (a, b, c), (d, e, f), (g, h, i)
    small = all(abs(value) <= 1 + RIGID_TOLERANCE for row in rows for value in row)
    rigid = small and all(
        abs(sum(map(mul, rows[m], rows[n])) - (m == n)) <= RIGID_TOLERANCE for m in range(3) for n in range(m, 3)
    )
    mirrored = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0
    affine = all(abs(value) <= _LAST_ROW for value in last[:3]) and abs(last[3] - 1) <= _LAST_ONE
    if not rigid or mirrored or not affine:
        return "must be a rigid transform: a rotation, a translation, last row 0 0 0 1"
    if i < MIN_UPRIGHT:
        return "must be upright: the sensor's z axis within 60 degrees of the world's"
    if not all(abs(value) <= MAX_TRANSLATION_M for value in (x, y, z)):
        return f"must lie within {MAX_TRANSLATION_M:g} m of the world's origin"
    return None


def from_world(boxes: FloatArray, pose: FloatArray) -> FloatArray:
    """Boxes of the world frame in the frame of a sensor.

    Parameters
    ----------
    boxes : (n, 5+) ndarray
        World frame.
    pose : (4, 4) ndarray
        world_from_sensor; only its motion in the plane counts.

    Returns
    -------
    (n, 5+) ndarray
        Sensor frame, yaw wrapped to [-pi, pi).
    """
    boxes, pose = as_boxes(boxes), as_pose(pose)
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    dx, dy = boxes[:, 0] - pose[0, 3], boxes[:, 1] - pose[1, 3]
    moved = np.array(boxes, dtype=np.float64)
    moved[:, 0], moved[:, 1] = c * dx + s * dy, -s * dx + c * dy
    moved[:, 4] = np.mod(boxes[:, 4] - yaw + np.pi, 2 * np.pi) - np.pi
    return moved


def to_world(boxes: FloatArray, pose: FloatArray) -> FloatArray:
    """Boxes (n, 5+) of a sensor's frame in the world frame; the inverse of `from_world`, of a tilted sensor too."""
    boxes, pose = as_boxes(boxes), as_pose(pose)
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    moved = np.array(boxes, dtype=np.float64)
    moved[:, 0] = c * boxes[:, 0] - s * boxes[:, 1] + pose[0, 3]
    moved[:, 1] = s * boxes[:, 0] + c * boxes[:, 1] + pose[1, 3]
    moved[:, 4] = np.mod(boxes[:, 4] + yaw + np.pi, 2 * np.pi) - np.pi
    return moved


def corners(boxes: FloatArray) -> FloatArray:
    """Corners (n, 4, 2) of boxes (n, 5+), counter-clockwise from front left."""
    boxes = as_boxes(boxes)
    local = _UNIT_CORNERS[None] * boxes[:, None, 2:4]
    c, s = np.cos(boxes[:, 4:5]), np.sin(boxes[:, 4:5])
    x = c * local[..., 0] - s * local[..., 1] + boxes[:, 0:1]
    y = s * local[..., 0] + c * local[..., 1] + boxes[:, 1:2]
    return np.stack([x, y], axis=-1)


def pairwise_iou(a: FloatArray, b: FloatArray) -> FloatArray:
    """Intersection over union of every pair of rotated boxes.

    The intersection needs no polygon: in the frame of box B, the slice of A at abscissa x, cut to B, has the length
    ``clamp(y_top) - clamp(y_bottom)`` with clamp to half the width of B. Its integral over x within half the length of
    B is a sum over A's four edges, each in closed form (Green's theorem). Exact for touching, nested and identical
    boxes.

    Parameters
    ----------
    a : (n, 5+) ndarray
    b : (m, 5+) ndarray

    Returns
    -------
    (n, m) float64 ndarray
        In [0, 1]; 0 where a box has no area.
    """
    a, b = as_boxes(a, "a"), as_boxes(b, "b")
    iou = np.zeros((len(a), len(b)))
    if not iou.size:
        return iou
    radius_a, radius_b = np.hypot(a[:, 2], a[:, 3]) / 2, np.hypot(b[:, 2], b[:, 3]) / 2
    distance2 = (a[:, 0, None] - b[None, :, 0]) ** 2 + (a[:, 1, None] - b[None, :, 1]) ** 2
    i, j = np.nonzero(distance2 < (radius_a[:, None] + radius_b[None, :]) ** 2)
    for first in range(0, len(i), _AT_A_TIME):  # of boxes that all overlap, every pair needs room for its outline
        some = slice(first, first + _AT_A_TIME)
        iou[i[some], j[some]] = _paired_iou(a[i[some]], b[j[some]])
    return iou


def laid_iou(a: FloatArray, b: FloatArray) -> FloatArray:
    """Intersection over union (n,) of boxes a and b, (n, 5+) each, laid on one another pair by pair: centre on centre.

    It is 1 where they have the same shape: the same length and width, and the same heading but for half a turn.
    """
    laid = np.array(b)
    laid[:, :2] = a[:, :2]
    return _paired_iou(a, laid)


def _paired_iou(a: FloatArray, b: FloatArray) -> FloatArray:
    """IoU (n,) of boxes (n, 5+) with as many others, pair by pair."""
    c, s = np.cos(b[:, 4]), np.sin(b[:, 4])
    x, y = _outline(a)
    x -= b[:, 0]
    y -= b[:, 1]
    x, y = c * x + s * y, c * y - s * x
    half_l, half_w = b[:, 2] / 2, b[:, 3] / 2
    cut = np.minimum(np.maximum(x, -half_l), half_l)
    x_from, x_to = cut[:-1], cut[1:]
    slope = np.zeros_like(x_from)
    np.divide(y[1:] - y[:-1], x[1:] - x[:-1], out=slope, where=x_from != x_to)
    y_from, y_to = y[:-1] + (x_from - x[:-1]) * slope, y[:-1] + (x_to - x[:-1]) * slope
    area = np.abs(((x_to - x_from) * _mean_clamp(y_from, y_to, half_w)).sum(axis=0))

    total = a[:, 2] * a[:, 3] + b[:, 2] * b[:, 3] - area
    iou = np.zeros_like(area)
    np.divide(area, total, out=iou, where=total > 0)
    bounded: FloatArray = np.minimum(np.maximum(iou, 0.0), 1.0)
    return bounded


def _outline(boxes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """x and y (5, n) of the corners of boxes (n, 5+), as `corners` gives them, the first once more at the end."""
    ahead, aside = _CLOSED[:, :1] * boxes[:, 2], _CLOSED[:, 1:] * boxes[:, 3]
    c, s = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    return c * ahead - s * aside + boxes[:, 0], s * ahead + c * aside + boxes[:, 1]


def _mean_clamp(p: FloatArray, q: FloatArray, limit: FloatArray) -> FloatArray:
    """Mean of clamp(y, -limit, limit) for y going linearly from p to q."""
    low, high = np.minimum(p, q), np.maximum(p, q)
    below = np.minimum(high, -limit) - np.minimum(low, -limit)
    above = np.maximum(high, limit) - np.maximum(low, limit)
    a, b = np.minimum(np.maximum(low, -limit), limit), np.minimum(np.maximum(high, -limit), limit)
    whole = (above - below) * limit + (b - a) * (a + b) / 2
    np.divide(whole, high - low, out=a, where=high > low)
    return a


def nms(boxes: FloatArray, scores: FloatArray, iou_threshold: float) -> IntArray:
    """Greedy non-maximum suppression.

    Boxes are taken by descending score (ties in input order); one is dropped if its IoU with a kept one exceeds the
    threshold. Works in blocks, so that memory stays linear and what an early box suppresses is never looked at again.

    Parameters
    ----------
    boxes : (n, 5+) ndarray
    scores : (n,) ndarray
    iou_threshold : float
        In [0, 1].

    Returns
    -------
    (k,) int64 ndarray
        Indices of the kept boxes, best first.
    """
    boxes = as_boxes(boxes)
    scores = np.asarray(scores, dtype=np.float64)
    if scores.shape != (len(boxes),):
        raise ValueError(f"scores must be one for each of {len(boxes)} boxes, got shape {scores.shape}")
    if not 0 <= iou_threshold <= 1:
        raise ValueError(f"iou_threshold must be in [0, 1], got {iou_threshold}")
    order = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(order):
        block, order = order[:_NMS_BLOCK], order[_NMS_BLOCK:]
        overlap = pairwise_iou(boxes[block], boxes[block]) > iou_threshold
        overlap.flat[:: len(block) + 1] = False  # with themselves
        alive = np.ones(len(block), dtype=bool)
        for i in np.flatnonzero(overlap.any(axis=1)).tolist():
            if alive[i]:
                alive[i + 1 :] &= ~overlap[i, i + 1 :]
        survivors = block[alive]
        kept.extend(int(i) for i in survivors)
        if len(order):
            order = order[~np.any(pairwise_iou(boxes[order], boxes[survivors]) > iou_threshold, axis=1)]
    return np.array(kept, dtype=np.int64)


BOX_UNITS = (100, 100, 100, 100, 1000, 10000)
"""Units of what is kept of a box, as parts of 1: x, y, length and width in cm, yaw in mrad, score in 1e-4."""
MOST_UNITS = 2**29


def in_units(boxes: FloatArray) -> IntArray:
    """Boxes (n, 6) as whole numbers of `BOX_UNITS`, at most 2**29 either way.

    Raises
    ------
    ValueError
        If one is no number.
    """
    scaled = np.round(as_boxes(boxes, columns=len(BOX_UNITS)) * BOX_UNITS)
    if np.isnan(scaled).any():
        raise ValueError("boxes must be numbers")
    whole: IntArray = np.clip(scaled, -MOST_UNITS, MOST_UNITS).astype(np.int64)
    return whole


def from_units(whole: IntArray) -> FloatArray:
    """The boxes (n, 6) of `in_units`."""
    boxes: FloatArray = whole / np.array(BOX_UNITS, dtype=np.float64)
    return boxes
