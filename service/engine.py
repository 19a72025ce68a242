"""Detectors and the one thread they run on."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from robosac.deadline import Deadline
from robosac.detectors import Detector, Message, available, blank, load
from robosac.fusion import FusionResult
from robosac.session import Session
from service.errors import Kind, Refused

T = TypeVar("T")


class Engine:
    """Runs fusions one after another on a thread of its own, so that the event loop never waits for torch.

    Parameters
    ----------
    threads : int
        Torch threads of one pass.
    extra_detectors : sequence of str
        Beside those that ship, or in the place of one of the same name: weights files or ``module:callable``.
    """

    def __init__(self, threads: int, extra_detectors: Sequence[str] = ()) -> None:
        self._extra = extra_detectors
        self._executor = ThreadPoolExecutor(1, "fusion", initializer=torch.set_num_threads, initargs=(threads,))
        self._detectors: dict[str, Detector] = {}
        self.ready = False

    @property
    def detectors(self) -> Mapping[str, Detector]:
        """Loaded detectors by name; empty before `start`."""
        return self._detectors

    async def start(self) -> None:
        """Load every detector and run one frame through each, so that the first answer is as fast as the next.

        Raises
        ------
        ValueError
            If a detector cannot be loaded, or two extra ones have the same name.
        """
        extra = [await self._submit(partial(load, detector)) for detector in self._extra]
        own = {detector.info.name: detector for detector in extra}
        if len(own) < len(extra):
            raise ValueError(f"two of the extra detectors have the same name: {[d.info.name for d in extra]}")
        shipped = {name: await self._submit(partial(load, name)) for name in available() if name not in own}
        self._detectors = shipped | own
        for detector in self._detectors.values():
            await self._submit(partial(_warm_up, detector))
        self.ready = True

    def check_ready(self) -> None:
        """Refuse as long as not every detector is loaded and warm, or once the engine is stopped."""
        if not self.ready:
            raise Refused(Kind.NOT_READY, "the gateway is still warming up")

    async def decide(
        self,
        session: Session,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        seed: int,
        deadline: Deadline,
    ) -> tuple[FusionResult, float]:
        """Decide a frame on the engine's thread, from what the session remembers at this moment.

        Returns the result, and for how many milliseconds the frame waited for the thread.
        """
        submitted, asked = time.perf_counter(), copy(session)

        def work() -> tuple[FusionResult, float]:
            waited_ms = (time.perf_counter() - submitted) * 1e3
            return asked.decide(frame, ego, teammates, np.random.default_rng(seed), deadline), waited_ms

        return await self._submit(work)

    def stop(self) -> None:
        """Finish what was submitted."""
        self.ready = False
        self._executor.shutdown(wait=True)

    async def _submit(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._executor, work)


def _warm_up(detector: Detector) -> None:
    ego, teammate = blank(detector.info, "ego"), blank(detector.info, "teammate")
    for _ in range(2):
        prepared = detector.prepare(ego, {"a": teammate, "b": teammate})
        prepared.detect()
        prepared.detect(["a", "b"])
