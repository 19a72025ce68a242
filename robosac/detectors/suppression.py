"""Non-maximum suppression on an accelerator.

How many candidates there are must not matter there, or the processor would have to wait for their number. So only the
best are looked at. NVIDIA's accelerators have kernels of ours for it (``suppression.cu``). On others all pairs are
compared, and who is suppressed is settled in a fixed number of rounds. Where either is not enough, candidates come back
as they are, and the processor suppresses.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib import resources

import numpy as np
import torch

from robosac.boxes import FloatArray, IntArray
from robosac.detectors.recorded import Tensors, can_record

logger = logging.getLogger(__name__)

LOOKED_AT = 256
"""Candidates of a map that are compared; a multiple of 32."""
ROUNDS = 8
"""In each, what no survivor of the round before overlaps survives: after as many as suppressions follow from one
another, nothing changes any more.
"""
Kernel = Callable[..., None]
"""To be called with the blocks, the threads of a block, and the arguments."""
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
    boxes : (n, m, 5) float32 tensor
        What the codes of the first mean, as many as are looked at: x, y, length, width, yaw.
    iou : float
        Of two that overlap more than this, the better one suppresses the other.
    """
    if (kernels := _kernels(logits.device)) is not None:
        return _by_kernels(*kernels, logits, index, codes, boxes, iou), logits, index, codes
    candidate = logits > -torch.inf
    looked_at = candidate[:, :LOOKED_AT]
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


@lru_cache(maxsize=16)
def _kernels(device: torch.device) -> tuple[Kernel, Kernel] | None:
    """Both kernels on an accelerator of NVIDIA's; None on others, and where torch cannot compile them."""
    if not can_record(device):
        return None
    source = resources.files("robosac.detectors").joinpath("suppression.cu").read_text(encoding="utf-8")
    source = f"#define MOST {LOOKED_AT}\n{source}"
    try:
        with torch.cuda.device(device):
            return torch.cuda._compile_kernel(source, "compare"), torch.cuda._compile_kernel(source, "suppress")
    except (AttributeError, OSError, RuntimeError) as error:  # not every torch has it, and it needs NVRTC
        logger.warning("boxes are suppressed on %s without a kernel, which takes longer: %s", device, error)
        return None


def _by_kernels(
    compare: Kernel,
    suppress: Kernel,
    logits: torch.Tensor,
    index: torch.Tensor,
    codes: torch.Tensor,
    boxes: torch.Tensor,
    iou: float,
) -> torch.Tensor:
    """What `brought_back` looks at first."""
    logits, codes, boxes = (numbers.float().contiguous() for numbers in (logits, codes, boxes))
    index = index.long().contiguous()
    (maps, each, width), looked_at = codes.shape, boxes.shape[1]
    better = index.new_empty((maps, looked_at, LOOKED_AT // 32), dtype=torch.int32)
    few = codes.new_empty((maps, looked_at, 4 + width))
    threads = (LOOKED_AT, 1, 1)
    with torch.cuda.device(logits.device):
        compare((maps, LOOKED_AT // 32, 1), threads, [logits, boxes, better, each, looked_at, iou])
        suppress((maps, 1, 1), threads, [logits, index, codes, better, few, each, looked_at, width])
    return few


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
    # as differences of like numbers, or rounding is all that is left of an edge along one of the other box
    below = torch.minimum(high, -limit) - torch.minimum(low, -limit)
    above = torch.maximum(high, limit) - torch.maximum(low, limit)
    a, b = low.clamp(-limit, limit), high.clamp(-limit, limit)
    whole = (above - below) * limit + (b - a) * (a + b) / 2
    return torch.where(high > low, whole / (high - low), a)
