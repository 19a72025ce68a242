"""Times at which the event loop looked at nothing, as it sees them itself."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

TICK_S = 0.005
"""Time between two looks at the clock."""
STALL_S = 0.015
"""A longer time between two looks is a stall; what a shorter one hides of a frame's time stays hidden."""
ROUNDS = 8
"""Rounds of the loop after a stall in which all that came meanwhile is taken from its sockets, those included that have
to be accepted first. Without a backlog they take less than a millisecond.
"""


class LoopWatch:
    """Says since when bytes may have waited that the event loop hands over now.

    A server learns of a request when the loop gets round to its socket. If something held the loop before, the request
    may have waited for all that time, and nothing in it tells. So a timer looks at the clock every few milliseconds.
    What comes in the next rounds after a look that was late is taken to have come when the loop was last seen alive:
    the frame's budget may then seem shorter than it is, but never longer.

    Parameters
    ----------
    clock : callable
        Monotonic, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._last = clock()
        self._stalled_since = self._last
        self._rounds = 0
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Watch the loop that runs."""
        self._last = self._clock()
        self._wait()

    def stop(self) -> None:
        """Watch no longer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def arrived(self) -> float:
        """The earliest time at which what is seen now may have come."""
        now = self._clock()
        if self._timer is None:
            return now
        if self._rounds:
            return self._stalled_since
        return self._last if now - self._last > STALL_S else now  # the timer may not have had its turn yet

    def look(self) -> None:
        """Look at the clock."""
        now = self._clock()
        if now - self._last > STALL_S:
            if not self._rounds:  # else it is one stall with a breath in it
                self._stalled_since = self._last
                asyncio.get_running_loop().call_soon(self._next_round)
            self._rounds = ROUNDS
        self._last = now

    def _next_round(self) -> None:
        self._rounds -= 1
        if self._rounds:
            asyncio.get_running_loop().call_soon(self._next_round)

    def _wait(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(TICK_S, self._tick)

    def _tick(self) -> None:
        self.look()
        self._wait()
