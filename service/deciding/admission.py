"""How many frames are taken on at a time: no more than can be answered within their budgets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from robosac.deadline import Deadline
from service.errors import Kind, Refused

SHARE = 0.5
"""Part of a frame's budget that the frames before it may take."""
SESSION_FRAMES = 3
"""Frames of one session in hand or waiting at a time, so that no ego takes the others' share."""
FIRST_GUESS_S = 0.02
SMOOTHING = 0.1


class Admission:
    """Counts the frames in hand and estimates from the latest what one costs.

    A frame is admitted if the work before it and its own are expected to end within `SHARE` of its budget. What a frame
    costs is the time from the moment that it could be worked on, or from the end of the frame before it if that was
    later, to its own end: under load, the inverse of the throughput. Frames that wait for their teammates count as
    frames in hand, since they may all wake at once.
    """

    def __init__(self) -> None:
        self._store_s = 0.0
        self._frames = 0
        self._by_session: dict[str, int] = {}
        self._cost_s = FIRST_GUESS_S
        self._last_end = 0.0

    def check(self, session_id: str, budget_s: float) -> None:
        """Refuse a frame that is not expected to be answered in time.

        Raises
        ------
        Refused
            With the kind ``overloaded``.
        """
        busy_s = self._frames * self._cost_s
        if self._frames and busy_s + self._cost_s > SHARE * budget_s:
            raise _overloaded("the gateway has more frames in hand than it can answer in time", busy_s)
        if self._by_session.get(session_id, 0) >= SESSION_FRAMES:
            raise _overloaded(f"{SESSION_FRAMES} frames of this session are in hand", busy_s)

    @contextmanager
    def frame(self, session_id: str, budget_s: float) -> Iterator[None]:
        """Take a frame on for the length of a block, or refuse it as `check` does."""
        self.check(session_id, budget_s)
        self._frames += 1
        self._by_session[session_id] = self._by_session.get(session_id, 0) + 1
        try:
            yield
        finally:
            self._frames -= 1
            self._by_session[session_id] -= 1
            if not self._by_session[session_id]:
                del self._by_session[session_id]

    def deadline(self, arrived: float, budget_s: float) -> Deadline:
        """The deadline of a frame that arrived then (`time.perf_counter`); time to keep its decision is reserved."""
        return Deadline(arrived + budget_s, self._store_s)

    def learn(self, start: float, end: float, store_s: float) -> None:
        """Take a frame into account.

        Parameters
        ----------
        start, end : float
            When it could be worked on, and when it was done; seconds on one clock.
        store_s : float
            What keeping its decision cost.
        """
        self._cost_s += SMOOTHING * (end - max(start, self._last_end) - self._cost_s)
        self._last_end = end
        self._store_s += SMOOTHING * (store_s - self._store_s)


def _overloaded(detail: str, busy_s: float) -> Refused:
    return Refused(Kind.OVERLOADED, detail, retry_after_s=max(1, math.ceil(busy_s)))
