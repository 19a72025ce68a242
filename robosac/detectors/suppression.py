"""Non-maximum suppression on an accelerator.

How many candidates there are must not matter there, or the processor would have to wait for their number. So all pairs
of the best are compared, and who is suppressed is settled in a fixed number of rounds. Where either is not enough,
candidates come back as they are, and the processor suppresses.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from robosac.boxes import FloatArray, IntArray
from robosac.detectors.recorded import Tensors

LOOKED_AT = 256
"""Candidates of a map that are compared."""
ROUNDS = 8
"""In each, what no survivor of the round before overlaps survives: after as many as suppressions follow from one
another, nothing changes any more.
"""
Picked = tuple[IntArray, FloatArray, FloatArray]
"""Candidates: numbers (k,), logits (k,) and codes (k, C), as float32."""


def suppressed(
    logits: torch.Tensor, index: torch.Tensor, codes: torch.Tensor, boxes: torch.Tensor, iou: float
) -> Tensors:
    """What `brought_back` wants.

    Parameters
    ----------
    logits : (n, k) tensor
        Of each map, best first; minus infinity where there is no candidate.
    index : (n, k) tensor
        Which places of a map they are.
    codes : (n, k, C) tensor
    boxes : (n, k, 5) float32 tensor
        What the codes mean: x, y, length, width, yaw.
    iou : float
        Of two that overlap more than this, the better one suppresses the other.
    """
    candidate = logits > -torch.inf
    looked_at, boxes = candidate[:, :LOOKED_AT], boxes[:, :LOOKED_AT]
    overlaps = (_ious(boxes) > iou).tril(-1).float()  # of each, which better ones
    survives = before = looked_at
    for _ in range(ROUNDS):
        before = survives
        survives = looked_at & (torch.bmm(overlaps, before[..., None].float())[..., 0] == 0)
    settled = (survives == before).all(1) & ~candidate[:, LOOKED_AT:].any(1)
    seen = slice(None, LOOKED_AT)
    columns = (logits, index, survives, settled[:, None].expand_as(survives))
    few = torch.cat([torch.stack([each[:, seen].float() for each in columns], 2), codes[:, seen].float()], 2)
    return few, logits, index, codes


def brought_back(
    few: torch.Tensor, logits: torch.Tensor, index: torch.Tensor, codes: torch.Tensor
) -> Iterator[tuple[Picked, bool]]:
    """Of each map what `suppressed` has found: those that survive, best first, and True; or all candidates by ascending
    number, and False, where the processor has to suppress.
    """
    for i, rows in enumerate(few.cpu().numpy()):
        if rows[0, 3]:
            kept = rows[rows[:, 2] > 0]
            yield (kept[:, 1].astype(np.int64), kept[:, 0], kept[:, 4:]), True
        else:
            value, number, code = (each[i].cpu().numpy() for each in (logits, index, codes))
            ascending = np.argsort(number)
            chosen = ascending[value[ascending] > -np.inf]
            yield (number[chosen], value[chosen].astype(np.float32), code[chosen].astype(np.float32)), False


def _ious(boxes: torch.Tensor) -> torch.Tensor:
    """IoU (n, k, k) of all boxes (n, k, 5) of a map, as `robosac.boxes.pairwise_iou` computes it; it may be NaN."""
    x, y, length, width, yaw = boxes.unbind(-1)
    by_corner = len(boxes), 5, boxes.shape[1], boxes.shape[1]
    c, s, one = yaw.cos(), yaw.sin(), torch.ones_like(yaw)
    ahead = torch.stack([length, -length, -length, length, length], 1) / 2
    aside = torch.stack([width, width, -width, -width, width], 1) / 2
    outline_x = c[:, None] * ahead - s[:, None] * aside + x[:, None]
    outline_y = s[:, None] * ahead + c[:, None] * aside + y[:, None]
    outlines = torch.stack([outline_x, outline_y, one[:, None].expand_as(outline_x)], 3).flatten(1, 2)
    # in the frame of each: (n, 5 k, k), corner by corner
    xs = torch.bmm(outlines, torch.stack([c, s, -(c * x + s * y)], 1)).view(by_corner)
    ys = torch.bmm(outlines, torch.stack([-s, c, s * x - c * y], 1)).view(by_corner)
    half_l, half_w = length[:, None, None] / 2, width[:, None, None] / 2
    cut = xs.clamp(-half_l, half_l)
    x_from, x_to, first = cut[:, :-1], cut[:, 1:], xs[:, :-1]
    run = x_to - x_from
    slope = torch.where(run != 0, (ys[:, 1:] - ys[:, :-1]) / (xs[:, 1:] - first), 0.0)
    y_from = torch.addcmul(ys[:, :-1], x_from - first, slope)
    y_to = torch.addcmul(y_from, run, slope)
    area = (run * _mean_clamp(y_from, y_to, half_w)).sum(1).abs()
    each = length * width
    iou: torch.Tensor = area / (each[:, :, None] + each[:, None] - area)
    return iou


def _mean_clamp(p: torch.Tensor, q: torch.Tensor, limit: torch.Tensor) -> torch.Tensor:
    """As in `robosac.boxes`: the mean of clamp(y, -limit, limit) for y going linearly from p to q."""
    low, high = torch.minimum(p, q), torch.maximum(p, q)
    a, b = low.clamp(-limit, limit), high.clamp(-limit, limit)
    beyond = (high - b).abs() - (low - a).abs()  # how much of it is above, less how much is below
    whole = beyond * limit + (b - a) * (a + b) / 2
    return torch.where(high > low, whole / (high - low), a)
