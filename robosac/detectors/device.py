"""The device that a detector computes on: the processor, or an accelerator of torch's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from robosac.detectors.base import DetectorInfo

CPU = torch.device("cpu")


def as_device(device: str) -> torch.device:
    """A device by torch's name for it, such as ``cpu``, ``cuda`` or ``cuda:1``.

    Raises
    ------
    ValueError
        If torch cannot compute there.
    """
    try:
        chosen = torch.device(device)
        torch.ones(1, device=chosen).sum().item()
    except (AssertionError, ImportError, RuntimeError) as error:  # torch has no type of its own for it
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"torch cannot compute on the device {device!r} here: {reason}") from error
    return CPU if chosen.type == "cpu" else chosen


def on_device(info: DetectorInfo, device: torch.device) -> DetectorInfo:
    """The face of the same detector on a device."""
    return replace(info, device=str(device))


def stacked(arrays: Sequence[np.ndarray[Any, np.dtype[Any]]], device: torch.device = CPU) -> torch.Tensor:
    """Arrays of one shape and type together on a device, float32 and in C order.

    They go up in their own type, at once, and are widened there. Torch widens half floats several times faster than
    numpy. To add maps of unlike layouts takes far longer, hence the C order.
    """
    return gone_up(arrays, device).float()


def by_cell(maps: Sequence[np.ndarray[Any, np.dtype[Any]]], device: torch.device = CPU) -> torch.Tensor:
    """Maps (C, H, W) as `stacked`, (n, C, H, W), but with the channels of a cell side by side in memory."""
    sent = gone_up(maps, device)
    if device != CPU:
        return sent.float().contiguous(memory_format=torch.channels_last)
    count, channels, *size = sent.shape
    cells = torch.empty((count, *size, channels), dtype=torch.float32, device=device)
    for each, of in zip(cells.flatten(1, 2), sent.flatten(2), strict=True):
        each.copy_(of.T.contiguous())  # one matrix is turned over faster than many at once, and before it is widened
    return cells.permute(0, 3, 1, 2)


def gone_up(arrays: Sequence[np.ndarray[Any, np.dtype[Any]]], device: torch.device = CPU) -> torch.Tensor:
    """Arrays together on a device, in their own type and in C order."""
    pinned = device.type == "cuda"  # so that nothing waits for them to arrive
    wide = np.result_type(*{array.dtype for array in arrays}).newbyteorder("=")  # torch knows no other order
    dtype = torch.from_numpy(np.empty(0, wide)).dtype
    together = torch.empty((len(arrays), *arrays[0].shape), dtype=dtype, pin_memory=pinned)
    np.stack(arrays, out=together.numpy())
    return together.to(device, non_blocking=pinned)
