"""Functions that an accelerator plays back: hundreds of small kernels are started at once, not one by one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

Tensors = tuple[torch.Tensor, ...]
Function = Callable[..., Tensors]


class Recorded:
    """A function of tensors, recorded as a CUDA graph for each shape of its arguments; elsewhere it is just called.

    Which kernels it starts may depend on shapes only, and nothing in it may wait for the device or come from the
    processor. What it returns is overwritten by the next call.

    Parameters
    ----------
    function : callable
        From tensors on one device to a tuple of tensors.
    """

    def __init__(self, function: Function) -> None:
        self._function = function
        self._recordings: dict[Any, tuple[torch.cuda.CUDAGraph, Tensors, Tensors]] = {}
        self._pool: Any = None

    def __call__(self, *given: torch.Tensor) -> Tensors:
        """What the function returns."""
        if given[0].device.type != "cuda":
            return self._function(*given)
        key = tuple((each.shape, each.stride(), each.dtype) for each in given)
        if key not in self._recordings:
            self._recordings[key] = self._record(given)
        graph, taken, returned = self._recordings[key]
        for mine, each in zip(taken, given, strict=True):
            mine.copy_(each)
        graph.replay()
        return returned

    def __deepcopy__(self, memo: dict[int, Any]) -> Recorded:
        """The same function, not recorded yet: a recording works on the tensors that it was made with."""
        return Recorded(self._function)

    def _record(self, given: Tensors) -> tuple[torch.cuda.CUDAGraph, Tensors, Tensors]:
        taken = tuple(each.clone() for each in given)
        aside = torch.cuda.Stream(given[0].device)  # type: ignore[no-untyped-call]
        aside.wait_stream(torch.cuda.current_stream(given[0].device))
        with torch.cuda.stream(aside):
            for _ in range(2):  # libraries choose their algorithms in the first calls, which cannot be recorded
                self._function(*taken)
        torch.cuda.current_stream(given[0].device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()  # recordings are played one at a time, and can share memory
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            returned = self._function(*taken)
        return graph, taken, returned
