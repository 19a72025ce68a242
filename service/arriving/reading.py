"""Bodies that take long to read: some of each at a time, on other threads than the event loop's, by fair shares."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import TypeVar

from robosac.steps import Steps, done_within
from service.arriving.giving_way import Line, Turn, Waiting
from service.arriving.pacing import Pacing, Party
from service.arriving.parties import Parties
from service.engine import Engine
from service.errors import Kind, Refused
from service.sessions.live import Caller
from service.turns import Work

T = TypeVar("T")

_CORES = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
READ_AT_A_TIME = min(_CORES, 2)
"""Bodies, so that reading does not press fusion out of a single core."""
READ_S = 0.005
"""For how long about a body is read before others have their turns: one of many messages may take ten times as long."""
MOST_S = 5.0
"""After which a turn to read holds up no other: none takes so long."""
SHARE = 0.5
"""Of its budget, for which a body may wait until it is read: later there is hardly time to answer it."""


class Reading:
    """Reads bodies by turns. What it takes counts in the shares of the detector's thread (`service.turns`), and whoever
    had least of those goes first: so who wants less waits for a turn that was begun, and not for all the bodies that
    others send. Where there is a single core, bodies wait for frames that go before them, too. The vehicles of a
    session have the same number of turns.

    Parameters
    ----------
    engine : Engine
        Has the shares.
    pacing : Pacing
        Lets whoever has the event loop's time wait, and is told of the time that reading takes.
    """

    def __init__(self, engine: Engine, pacing: Pacing) -> None:
        self.pacing = pacing
        self._engine = engine
        self._line = FairLine(engine, gives_way=_CORES == 1)

    async def read(self, caller: Caller, steps: Steps[T]) -> T:
        """Read some of a body, and more once others had their turns, and more of the time besides.

        Raises
        ------
        Refused
            With the kind ``overloaded``, if others took so long that it can hardly be answered in time. For how long
            the body itself was on its way does not count.
        """
        party, left_s = Parties.of_token(caller.record, caller.vehicle_id), SHARE * caller.live.budget_s
        work = _work_of(caller.live.key, caller.record.session_id)
        with self._engine.elsewhere(work):
            while True:
                began, took_s = time.perf_counter(), list[float]()
                turn = await self._turn(caller, party, left_s)
                left_s -= time.perf_counter() - began
                some = asyncio.create_task(asyncio.to_thread(_timed, steps, took_s))
                some.add_done_callback(partial(self._read_some, turn, party, work, took_s))
                if (read := await asyncio.shield(some)) is not None:  # a thread works on though nobody waits for it
                    return read[0]

    async def _turn(self, caller: Caller, party: Party, within_s: float) -> Turn:
        try:
            async with asyncio.timeout(within_s):
                await self.pacing.turn(party)
                return await self._line.turn((caller.live.key, caller.record.session_id, caller.vehicle_id))
        except TimeoutError:
            detail = "bodies of other requests took the time that this one had"
            raise Refused(Kind.OVERLOADED, detail, retry_after_s=1) from None

    def _read_some(self, turn: Turn, party: Party, work: Work, took_s: list[float], some: asyncio.Task[object]) -> None:
        seconds = sum(took_s) / _CORES
        self.pacing.charge(party, seconds)
        self._engine.put_down(work, seconds)
        turn.end()
        if not some.cancelled():
            some.exception()  # it is told to whoever still waits


class FairLine(Line):
    """Lets the session go first that had least of its key's share, of the key that had least.

    Parameters
    ----------
    engine : Engine
    gives_way : bool
        Whether nobody goes on while frames are decided that go first.
    """

    def __init__(self, engine: Engine, *, gives_way: bool) -> None:
        super().__init__(lambda: False, READ_AT_A_TIME, MOST_S)
        self._engine = engine
        self._gives_way = gives_way

    def _take(self, waiting: Waiting) -> Turn | None:
        first = self._engine.first(_sessions(waiting))
        if self._gives_way and self._engine.puts_off(first):
            return None
        return waiting.take(first.key, first.session_id)


def _sessions(waiting: Waiting) -> Iterator[Work]:
    for key, of_key in waiting.members.items():
        for session_id in of_key.members:
            yield _work_of(key, session_id)


def _work_of(key: str, session_id: str) -> Work:
    return Work(key, session_id, due=0.0, expected_s=0.0)


def _timed(steps: Steps[T], took_s: list[float]) -> tuple[T] | None:
    """Some of the steps; and the processor time that they took is appended, whatever comes of them."""
    began = time.thread_time()
    try:
        return done_within(steps, READ_S)
    finally:
        took_s.append(time.thread_time() - began)
