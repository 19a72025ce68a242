"""Functions that an accelerator plays back: hundreds of small kernels are started at once, not one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

Tensors = tuple[torch.Tensor, ...]
Function = Callable[..., Tensors]
EACH = 8
"""Up to so many rows there is a recording for each number of them; beyond, for each power of two."""
MOST = 16
"""Rows of the largest recording, as each keeps its arguments on the device; more are computed without one."""


class Recorded:
    """A function of tensors, recorded as CUDA graphs; elsewhere it is just called.

    Which kernels it starts may depend on shapes only, and nothing in it may wait for the device or come from the
    processor. What it returns is overwritten by the next call.

    Parameters
    ----------
    function : callable
        From tensors on one device to tensors. Rows of the first are independent of each other; the others have as many
        rows, or one for all. So many rows have the results.
    """

    def __init__(self, function: Function) -> None:
        self._function = function
        self._recordings: dict[Any, tuple[torch.cuda.CUDAGraph, Tensors, Tensors]] = {}
        self._pool: Any = None

    def __call__(self, *given: torch.Tensor) -> Tensors:
        """What the function returns."""
        count = len(given[0])
        if not can_record(given[0].device) or count > MOST:
            return self._function(*given)
        size = count if count <= EACH else 1 << (count - 1).bit_length()
        rows = [1 if len(each) < count else size for each in given]
        key = tuple((n, each.shape[1:], each.dtype) for n, each in zip(rows, given, strict=True))
        if key not in self._recordings:
            padded = (torch.cat([each, *[each[-1:]] * (n - len(each))]) for n, each in zip(rows, given, strict=True))
            self._recordings[key] = self._record(tuple(padded))
        graph, taken, returned = self._recordings[key]
        # what is in the rows beyond changes nothing
        put([mine[: len(each)] for mine, each in zip(taken, given, strict=True)], given)
        graph.replay()
        return tuple(each[:count] for each in returned)

    def __deepcopy__(self, memo: dict[int, Any]) -> Recorded:
        """The same function, not recorded yet: a recording works on the tensors that it was made with."""
        return Recorded(self._function)

    def _record(self, taken: Tensors) -> tuple[torch.cuda.CUDAGraph, Tensors, Tensors]:
        device = taken[0].device
        aside = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        aside.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(aside):
            for _ in range(2):  # libraries choose their algorithms in the first calls, which cannot be recorded
                self._function(*taken)
        torch.cuda.current_stream(device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()  # recordings are played one at a time, and can share memory
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            returned = self._function(*taken)
        return graph, taken, returned


def copies(tensors: Sequence[torch.Tensor]) -> Tensors:
    """A copy of each of some tensors of one device."""
    of_each = tuple(map(torch.empty_like, tensors))
    put(of_each, tensors)
    return of_each


def put(into: Sequence[torch.Tensor], tensors: Sequence[torch.Tensor]) -> None:
    """Copy each of some tensors into another one; those of a type at once, as each copy would take a call."""
    for dtype in {each.dtype for each in tensors}:
        pairs = [pair for pair in zip(into, tensors, strict=True) if pair[1].dtype == dtype]
        torch._foreach_copy_([to for to, _ in pairs], [of for _, of in pairs])


def can_record(device: torch.device) -> bool:
    """Whether a device is one of NVIDIA's."""
    return device.type == "cuda"
