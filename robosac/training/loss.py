"""Targets and loss of the embedded detector: a centre heatmap and box codes at its peaks (after CenterNet)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray, IntArray
from robosac.detectors.decoding import HEAD_CELL_M, OWN_BODY_M, box_codes, cell_centres
from robosac.detectors.voxels import AREA_M

POSITIVE_HITS = 4
SIGMA_M = 0.9
REGRESSION_FROM = 0.5
IGNORE_FROM = 0.05
BOX_WEIGHT = 2.0


def targets(near: FloatArray, hits: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Targets of one ego.

    Parameters
    ----------
    near : (K, 5) ndarray
        Vehicles in the ego's frame.
    hits : (K,) ndarray
        Returns from each by the selected agents together. From 4 on a vehicle is positive, from 1 to 3 ignored, at 0
        it is background: nobody can know of it.

    Returns
    -------
    heat, weight : (64, 64) float32 ndarray
        Gaussian heatmap (1 in the cell of a centre), and its weight in the loss: 0 or 1.
    codes, code_weight : (6, 64, 64), (64, 64) float32 ndarray
        Box codes, and their weight in the loss: how close the cell is to a centre.
    """
    xs, ys = cell_centres()
    near_distance = np.hypot(xs, ys) < OWN_BODY_M
    heat = np.zeros(xs.shape, dtype=np.float32)
    weight = np.where(near_distance, 0.0, 1.0).astype(np.float32)
    codes = np.zeros((6, *xs.shape), dtype=np.float32)
    code_weight = np.zeros(xs.shape, dtype=np.float32)
    seen = hits > 0
    for box, count in zip(near[seen], hits[seen], strict=True):
        bump = np.exp(-((xs - box[0]) ** 2 + (ys - box[1]) ** 2) / (2 * SIGMA_M**2)).astype(np.float32)
        if count < POSITIVE_HITS:
            weight[bump > IGNORE_FROM] = 0.0
            continue
        row = int(np.floor((box[1] + AREA_M) / HEAD_CELL_M))
        column = int(np.floor((box[0] + AREA_M) / HEAD_CELL_M))
        bump[row, column] = 1.0
        closest = (bump > heat) & (bump >= REGRESSION_FROM)
        codes[:, closest] = box_codes(box, xs[closest], ys[closest])
        code_weight[closest] = bump[closest]
        heat = np.maximum(heat, bump)
    weight[(heat == 1.0) & ~near_distance] = 1.0
    code_weight[near_distance] = 0.0
    return heat, weight, codes, code_weight


def detection_loss(logits: torch.Tensor, codes: torch.Tensor, goal: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """Penalty-reduced focal loss of the heatmap plus twice the L1 loss of the box codes, per positive.

    Parameters
    ----------
    logits : (n, 64, 64) tensor
    codes : (n, 6, 64, 64) tensor
    goal : four tensors
        `targets`, stacked over n.
    """
    heat, weight, goal_codes, code_weight = goal
    p = torch.sigmoid(logits)
    centre = heat == 1.0
    positive = -functional.logsigmoid(logits) * (1 - p) ** 2
    negative = -functional.logsigmoid(-logits) * p**2 * (1 - heat) ** 4
    count = (centre * weight).sum().clamp(min=1.0)
    focal = (torch.where(centre, positive, negative) * weight).sum() / count
    box = ((codes - goal_codes).abs() * code_weight[:, None]).sum() / code_weight.sum().clamp(min=1.0)
    return focal + BOX_WEIGHT * box


def stack(goals: list[tuple[Any, ...]]) -> tuple[torch.Tensor, ...]:
    """Batch the targets of several egos."""
    return tuple(torch.from_numpy(np.stack(column)) for column in zip(*goals, strict=True))
