"""Frames that are being decided, and whose passes are made together."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from operator import attrgetter

from robosac.fusion import FusionResult
from robosac.passes import Pass
from robosac.steps import Steps
from service.turns import Work

LEAST = 0.8
"""Part of what a frame is expected to take that it takes at least, however little is tested."""
HOLD_S = 0.002
"""For so long a pass waits for those of other frames, if its frame has the time and they are not there yet."""
TOGETHER = 64
"""Subsets decoded in one pass of several frames."""


@dataclass(frozen=True)
class Decided:
    """A frame that is decided."""

    result: FusionResult
    worked_s: float
    """For how long it had the engine's thread."""
    waited_s: float
    """For how long it waited for its turns."""


class Job:
    """A frame that is being decided."""

    def __init__(self, work: Work, steps: Steps[FusionResult], others_s: float) -> None:
        self.work = work
        self.done: Future[Decided] = Future()
        self.outcome: Decided | BaseException = CancelledError()
        self.coming: Pass | None = None
        """The pass that its next step begins with, if others could be made with it."""
        self.came = 0.0
        """When that was known; seconds of `time.perf_counter`."""
        self._steps = steps
        self._submitted = time.perf_counter()
        self._had_s = work.had_s
        self._others_s = others_s
        """What all had when it was submitted."""

    def step(self) -> bool:
        """Do the next step; whether there are more. If not, what came of it waits to be told."""
        began = time.perf_counter()
        try:
            coming = next(self._steps)
        except StopIteration as stop:
            now = time.perf_counter()
            worked_s = self.work.had_s - self._had_s + now - began
            self.outcome = Decided(stop.value, worked_s, now - self._submitted - worked_s)
            return False
        except BaseException as error:
            self.outcome = error
            return False
        self.coming = coming if isinstance(coming, Pass) else None
        self.came = time.perf_counter()
        return True

    def is_hopeless(self, now: float, others_s: float) -> bool:
        """Whether it cannot be in time any more, for the time that others had."""
        late_s = now + LEAST * self.work.expected_s - self.work.due
        return self.work.had_s == 0 and 0 < late_s <= others_s - self._others_s

    def may_share(self, now: float) -> bool:
        """Whether its next step is a pass that may be made with those of others: together they take a little longer."""
        return self.coming is not None and now < self.work.due - self.work.left_s - HOLD_S

    def waits(self, now: float) -> bool:
        """Whether its pass waits for those of others."""
        return self.may_share(now) and now < self.came + HOLD_S

    def tell(self) -> None:
        """Tell whoever waits what came of it.

        That one may ask for the same work anew at once, so the job must be nobody's any more.
        """
        if not self.done.set_running_or_notify_cancel():
            return
        if isinstance(self.outcome, Decided):
            self.done.set_result(self.outcome)
        else:
            self.done.set_exception(self.outcome)


def with_company(job: Job, jobs: Iterable[Job], now: float) -> list[Job]:
    """A job, and those whose passes are made together with its own: whoever is due first comes first."""
    if job.coming is None or not job.may_share(now):
        return [job]
    family = job.coming.frame.family
    others = (o for o in jobs if o is not job and o.coming is not None and o.coming.frame.family is family)
    return [job, *sorted(others, key=attrgetter("work.due"))][:TOGETHER]


def waiting(jobs: Collection[Job], now: float) -> set[Work]:
    """Work whose passes wait for those of others; nobody waits if all would."""
    found = {job.work for job in jobs if job.waits(now)}
    return found if len(found) < len(jobs) else set()
