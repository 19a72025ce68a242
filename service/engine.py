"""Detectors and the one thread they run on."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import partial
from typing import TypeVar

import numpy as np
import structlog
import torch

from robosac.ahead import Ahead
from robosac.calibrated import calibration_fault, without_witness
from robosac.deadline import Deadline
from robosac.defenses import EGO
from robosac.detectors import Detector, Message, Preparer, available, load
from robosac.detectors.device import as_device
from robosac.detectors.loading import warm_up
from robosac.passes import together
from robosac.session import Session
from service.errors import Kind, Refused
from service.jobs import TOGETHER, Decided, Job, waiting, with_company
from service.turns import Turns, Work

logger = structlog.stdlib.get_logger(__name__)

T = TypeVar("T")


class Begun:
    """A frame of which the ego's message is there: what can be, is worked out while the others are waited for.

    Only time that nobody's frame wants is spent on it: a piece whose turn comes while frames are being decided is left
    to the frame itself.
    """

    def __init__(self, engine: Engine, detector: Preparer, ego: Message, *, reads: bool) -> None:
        self._engine = engine
        self._over = False
        self._reads = reads
        self.ahead = Ahead(detector, ego)
        self.spent_s = 0.0
        """For how long it had the engine's thread."""
        self._do(self.ahead.see_alone)
        if reads:
            self._do(partial(self.ahead.read, EGO, ego))

    def add(self, teammate: str, message: Message) -> None:
        """A teammate's message is there."""
        self._do(partial(self.ahead.lay, teammate, message))
        if self._reads:
            self._do(partial(self.ahead.read, teammate, message))

    def end(self) -> None:
        """No more pieces: the frame is decided now, or never."""
        self._over = True

    def _do(self, piece: Callable[[], None]) -> None:
        self._engine.when_idle(partial(self._piece, piece))

    def _piece(self, piece: Callable[[], None]) -> None:
        if self._over:
            return
        began = time.perf_counter()
        try:
            piece()
        except Exception:  # whatever is wrong shows when the frame is decided, and is told there
            logger.debug("nothing was worked out ahead", exc_info=True)
            self._over = True
        self.spent_s += time.perf_counter() - began


class Engine:
    """Decides frames on a thread of its own, pass by pass in turns, so that the event loop never waits for torch.

    Parameters
    ----------
    threads : int
        Torch threads of one pass.
    extra_detectors : sequence of str
        Beside those that ship, or in the place of one of the same name: weights files or ``module:callable``.
    device : str
        Where detectors compute, see `robosac.detectors.device.as_device`.
    """

    def __init__(self, threads: int, extra_detectors: Sequence[str] = (), device: str = "cpu") -> None:
        self._extra = extra_detectors
        self._device = device
        self._executor = ThreadPoolExecutor(1, "fusion", initializer=torch.set_num_threads, initargs=(threads,))
        self._lock = threading.Lock()
        self._turns = Turns()
        self._jobs: dict[Work, Job] = {}
        self._working = False
        self._detectors: dict[str, Detector] = {}
        self.ready = False

    @property
    def detectors(self) -> Mapping[str, Detector]:
        """Loaded detectors by name; empty before `start`."""
        return self._detectors

    async def find_device(self) -> None:
        """Raise `ValueError` if torch cannot compute on the device."""
        await self._submit(partial(as_device, self._device))

    async def start(self) -> None:
        """Load every detector and run one frame through each, so that the first answer is as fast as the next.

        Raises
        ------
        ValueError
            If a detector cannot be loaded or answers no frame of zeros, or two extra ones have the same name.
        """
        extra = [await self._submit(partial(load, detector, self._device)) for detector in self._extra]
        own = {detector.info.name: detector for detector in extra}
        if len(own) < len(extra):
            raise ValueError(f"two of the extra detectors have the same name: {[d.info.name for d in extra]}")
        shipped = {
            name: await self._submit(partial(load, name, self._device)) for name in available() if name not in own
        }
        self._detectors = shipped | own
        for name, detector in self._detectors.items():
            await self._submit(partial(warm_up, detector))
            if fault := await self._submit(partial(calibration_fault, detector.info)):
                logger.warning("group testing is refused", detector=name, why=fault)
            elif detector.info.calibration is not None and detector.info.witness is None:
                logger.warning("single objects are not judged", detector=name, why=without_witness(name))
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
        work: Work | None = None,
        ahead: Ahead | None = None,
    ) -> Decided:
        """Decide a frame on the engine's thread, from what the session remembers at this moment.

        Between two passes frames of other sessions may have their turns, see `service.turns`.

        Raises
        ------
        Refused
            With the kind ``overloaded``, if others had so many turns that it cannot be in time any more.
        """
        rng = np.random.default_rng(seed)
        steps = copy(session).decide_in_steps(frame, ego, teammates, rng, deadline, detector=ahead)
        work = Work("", "", math.inf, 0.0) if work is None else work
        with self._lock:
            self._jobs[work] = job = Job(work, steps, self._turns.charged_s)
            work.over = False
            self._turns.add(work)
            wake, self._working = not self._working, True
        if wake:
            self._executor.submit(self._work)
        return await asyncio.wrap_future(job.done)

    def order(self, works: Iterable[Work]) -> list[Work]:
        """As `service.turns.Turns.order`."""
        with self._lock:
            return self._turns.order(works)

    def lead(self, work: Work, other: Work) -> float:
        """As `service.turns.Turns.lead`."""
        with self._lock:
            return self._turns.lead(work, other)

    @contextlib.contextmanager
    def elsewhere(self, work: Work) -> Iterator[None]:
        """Let work that is done on other threads for the length of a block have its part in the shares."""
        with self._lock:
            self._turns.join(work)
        try:
            yield
        finally:
            with self._lock:
                self._turns.leave(work)

    def put_down(self, work: Work, seconds: float) -> None:
        """As `service.turns.Turns.put_down`."""
        with self._lock:
            self._turns.put_down(work, seconds)

    def first(self, works: Iterable[Work]) -> Work:
        """As `service.turns.Turns.first`."""
        with self._lock:
            return self._turns.first(works)

    def puts_off(self, work: Work) -> bool:
        """As `service.turns.Turns.puts_off`."""
        with self._lock:
            return self._turns.puts_off(work)

    def begin(self, session: Session, ego: Message) -> Begun:
        """Work out what can be of a session's frame while its teammates are waited for."""
        return Begun(self, session.detector, ego, reads=getattr(session.defense, "asks_witnesses", False))

    def when_idle(self, piece: Callable[[], None]) -> None:
        """Do a piece of work on the engine's thread, unless frames are being decided by then."""
        with contextlib.suppress(RuntimeError):  # the engine is being stopped
            self._executor.submit(self._unless_busy, piece)

    def _unless_busy(self, piece: Callable[[], None]) -> None:
        with self._lock:
            busy = len(self._turns) > 0
        if not busy:
            piece()

    def _work(self) -> None:
        """Do one step after the other, each of the work whose turn it is, until there is none. It is not handed to the
        thread step by step, since whoever hands work to a thread waits for the interpreter's lock.
        """
        try:
            while jobs := self._next():
                if len(jobs) > 1:
                    self._pass(jobs)
                    continue
                job, began = jobs[0], time.perf_counter()
                goes_on = not job.done.cancelled() and job.step()
                with self._lock:
                    self._turns.charge(job.work, time.perf_counter() - began)
                    if not goes_on:
                        self._remove(job)
                if not goes_on:
                    job.tell()
        except BaseException:
            self._working = False
            raise

    def _next(self) -> list[Job]:
        """The frame whose turn it is, with those whose passes are made with its own. Those that have become hopeless
        are refused.
        """
        with self._lock:
            now = time.perf_counter()
            for job in [job for job in self._jobs.values() if job.is_hopeless(now, self._turns.charged_s)]:
                self._remove(job)
                job.outcome = Refused(Kind.OVERLOADED, "other frames took the time that this one had", retry_after_s=1)
                job.tell()
            self._working = len(self._turns) > 0
            if not self._working:
                return []
            jobs = self._jobs.values()
            return with_company(self._jobs[self._turns.next(now, waiting(jobs, now))], jobs, now)

    def _pass(self, jobs: Sequence[Job]) -> None:
        """Make the passes of several frames as one. Each goes on when it has its turn."""
        coming = [job.coming for job in jobs if job.coming is not None]
        try:
            together(coming, TOGETHER)
        except Exception:  # each then makes its own, and whatever is wrong shows there
            logger.warning("passes could not be made together", frames=len(jobs), exc_info=True)
        with self._lock:
            for job, made in zip(jobs, coming, strict=True):
                self._turns.charge(job.work, made.spent_s)
                job.coming = None

    def _remove(self, job: Job) -> None:
        job.work.over = True
        self._turns.remove(job.work)
        del self._jobs[job.work]

    def stop(self) -> None:
        """Finish what was submitted."""
        self.ready = False
        self._executor.shutdown(wait=True)

    async def _submit(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._executor, work)
