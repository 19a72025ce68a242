"""Detectors and the one thread they run on."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from robosac.deadline import Deadline
from robosac.detectors import Detector, Message, available, blank, load
from robosac.fusion import FusionResult, Steps
from robosac.session import Session
from service.errors import Kind, Refused
from service.turns import Turns

T = TypeVar("T")


@dataclass(frozen=True)
class Decided:
    """A frame that is decided."""

    result: FusionResult
    worked_s: float
    """For how long it had the engine's thread."""
    waited_s: float
    """For how long it waited for its turns."""


class _Job:
    """A frame that is being decided."""

    def __init__(self, key: str, session_id: str, due: float, steps: Steps[FusionResult]) -> None:
        self.key, self.session_id, self.due = key, session_id, due
        self.done: Future[Decided] = Future()
        self._steps = steps
        self._submitted = time.perf_counter()
        self._worked_s = 0.0

    def step(self) -> bool:
        """Do the next step; whether there are more."""
        began = time.perf_counter()
        try:
            next(self._steps)
        except StopIteration as stop:
            now = time.perf_counter()
            worked_s = self._worked_s + now - began
            self._end(Decided(stop.value, worked_s, now - self._submitted - worked_s))
            return False
        except BaseException as error:
            if self.done.set_running_or_notify_cancel():
                self.done.set_exception(error)
            return False
        self._worked_s += time.perf_counter() - began
        return True

    def _end(self, decided: Decided) -> None:
        if self.done.set_running_or_notify_cancel():
            self.done.set_result(decided)


class Engine:
    """Decides frames on a thread of its own, pass by pass in turns, so that the event loop never waits for torch.

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
        self._lock = threading.Lock()
        self._turns: Turns[_Job] = Turns()
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
        *,
        key: str = "",
        session_id: str = "",
        due: float = math.inf,
    ) -> Decided:
        """Decide a frame on the engine's thread, from what the session remembers at this moment.

        Between two passes frames of other sessions may have their turns, see `service.turns`; a frame that is due first
        (``due``, of `time.perf_counter`) goes first where that is fair.
        """
        steps = copy(session).decide_in_steps(frame, ego, teammates, np.random.default_rng(seed), deadline)
        job = _Job(key, session_id, due, steps)
        with self._lock:
            self._turns.add(job)
        self._executor.submit(self._take_turn)
        return await asyncio.wrap_future(job.done)

    def _take_turn(self) -> None:
        """Do one step of the work whose turn it is. As many of these wait as there is work."""
        if not self._step():
            return
        try:
            self._executor.submit(self._take_turn)
        except RuntimeError:  # the engine is being stopped; what was begun is finished
            while self._turns:
                self._step()

    def _step(self) -> bool:
        """Do one step; whether there is more of the same work."""
        with self._lock:
            job = self._turns.next()
        began = time.perf_counter()
        goes_on = not job.done.cancelled() and job.step()
        with self._lock:
            self._turns.charge(job, time.perf_counter() - began)
            if not goes_on:
                self._turns.remove(job)
        return goes_on

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
