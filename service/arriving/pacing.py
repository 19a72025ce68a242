"""The event loop's time, shared by those who send: whoever took more than the others lately is read from later.

What comes costs time before anybody can say what it is worth: connections, heads, pieces of bodies, refusals. So the
time is measured that the loop spends on each connection and on its requests, and once the loop is short of time,
nothing more is read from those who had most. What was read of them last is kept, and the rest waits in the kernel.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

import asyncio
import functools
import math
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Generator
from typing import Any, Protocol

from starlette.types import ASGIApp, Receive, Scope, Send

KEY = "robosac_pacing"
"""In the state that the lifespan shares with servers."""
METER = "robosac_meter"
"""In a request's state: takes the time that its answer cost."""
OTHERS = "others"
"""The first part of the party of whoever shows no credential that counts."""
Party = tuple[str, str]
"""A key and who of it, viewers and which, or `OTHERS` and an address."""

LATELY_S = 0.05
"""What somebody had counts for about so long."""
LIMIT, LIMIT_BUSY = 0.5, 0.25
"""Part of the loop's time from which on it is short of time, and the same while others' frames are in hand."""
SLACK = 2.0
"""How many equal parts somebody may have before it has to wait: those who all want as much are not held up by turns."""
OF_OTHERS = 0.25
"""Part of the limit that counts as the equal part of all who show no credential."""
MOST_KEPT_BYTES = 2**25
"""Of what came and waits, of all connections together."""
_FORGOTTEN_S = 1.0
_LOOK_S = 0.002
"""How often it is looked whether somebody may be read from again, and for how long."""
LOOKED_AT = 64
"""Members of a party that are looked at each time, by turns."""


class Paced(Protocol):
    """A connection, or whatever else has to wait."""

    party: Party

    @property
    def is_gone(self) -> bool:
        """Whether it waits for nothing any more."""

    def go_on(self, pacing: Pacing) -> None:
        """Take what is kept of it, and read from it again."""


class _Pause:
    """Of whatever is no connection."""

    def __init__(self, party: Party) -> None:
        self.party = party
        self.is_over: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    @property
    def is_gone(self) -> bool:
        return self.is_over.done()

    def go_on(self, _: Pacing) -> None:
        self.is_over.set_result(None)


class _Part:
    """What somebody had of the time lately, as a part of it."""

    def __init__(self) -> None:
        self._value, self.at = 0.0, -math.inf

    def add(self, seconds: float, now: float) -> None:
        self._value, self.at = self.value(now) + seconds / LATELY_S, now

    def value(self, now: float) -> float:
        return self._value * math.exp(min(0.0, self.at - now) / LATELY_S)


class Pacing:
    """Knows what everybody had of the event loop's time lately, and whom it is to be kept from.

    That is whoever had more than `SLACK` equal parts of what there is (`LIMIT`, `LIMIT_BUSY`) while all together had as
    much as that: equal parts for API keys, and of a key's for its vehicles; others have `OF_OTHERS`, and of that each
    address an equal part. Whoever had least of its part goes on first, its members by turns.

    Parameters
    ----------
    party_of : callable
        Of a request's scope.
    busy : callable
        Whether frames are in hand, of others than this key if one is given: its own do not make it wait, unless it is
        the only one.
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        party_of: Callable[[Scope], Party],
        busy: Callable[[str | None], bool],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.party_of = party_of
        self._busy = busy
        self._clock = clock
        self._all = _Part()
        self._first: OrderedDict[str, _Part] = OrderedDict()
        self._members: dict[str, OrderedDict[str, _Part]] = {}
        self._waiting: dict[str, OrderedDict[str, deque[tuple[Paced, int]]]] = {}
        self._kept = 0
        self._look: asyncio.TimerHandle | None = None

    def charge(self, party: Party, seconds: float) -> None:
        """Somebody had so much of the loop's time."""
        now, (first, member) = self._clock(), party
        self._all.add(seconds, now)
        members = self._members.setdefault(first, OrderedDict())
        for parts, name in ((self._first, first), (members, member)):
            parts.setdefault(name, _Part()).add(seconds, now)
            parts.move_to_end(name)
        _forget(members, now)
        for gone in _forget(self._first, now):
            del self._members[gone]

    def is_over(self, party: Party) -> bool:
        """Whether the loop is short of time, and a party had more than its part of it."""
        now, (first, member) = self._clock(), party
        keys = len(self._first) - (OTHERS in self._first)
        limit = LIMIT_BUSY if self._busy(first if keys > 1 else None) else LIMIT
        if self._all.value(now) < limit or first not in self._first:
            return False
        part = SLACK * (limit * OF_OTHERS if first == OTHERS else limit / keys)
        members = self._members[first]
        return (
            self._first[first].value(now) > part
            and member in members
            and members[member].value(now) > part / len(members)
        )

    async def turn(self, party: Party) -> None:
        """Until a party may have more of the time."""
        if self.is_over(party):
            pause = _Pause(party)
            self.wait(pause, 0)
            await pause.is_over

    def wait(self, connection: Paced, kept: int) -> bool:
        """Let a connection of which so many bytes are kept go on (`Paced.go_on`) once its party may. False if too much
        is kept of others already.
        """
        if self._kept + kept > MOST_KEPT_BYTES:
            return False
        self._kept += kept
        first, member = connection.party
        self._waiting.setdefault(first, OrderedDict()).setdefault(member, deque()).append((connection, kept))
        self._look_later()
        return True

    def _look_later(self) -> None:
        if self._look is None:
            self._look = asyncio.get_running_loop().call_later(_LOOK_S, self._look_again)

    def _look_again(self) -> None:
        self._look = None
        until = self._clock() + _LOOK_S
        try:
            for first in sorted(self._waiting, key=self._claim):
                self._let_go_on(first, until)
        finally:
            if self._waiting:
                self._look_later()

    def _let_go_on(self, first: str, until: float) -> None:
        """Let members of a party go on that are over no part, one thing of each, as long as there is time."""
        members = self._waiting[first]
        for _ in range(min(len(members), LOOKED_AT)):
            member = next(iter(members))
            if self.is_over((first, member)):
                members.move_to_end(member)
            elif (one := self._next_of(first, member)) is not None:
                one.go_on(self)
            if not members or self._clock() > until:
                break

    def _next_of(self, first: str, member: str) -> Paced | None:
        members = self._waiting[first]
        waiting, found = members[member], None
        while waiting and found is None:
            connection, kept = waiting.popleft()
            self._kept -= kept
            found = None if connection.is_gone else connection
        members.move_to_end(member)
        if not waiting:
            del members[member]
        if not members:
            del self._waiting[first]
        return found

    def _claim(self, first: str) -> float:
        """What a party had of its part; who had least of it goes first."""
        if first not in self._first:
            return 0.0
        keys = max(len(self._first) - (OTHERS in self._first), 1)
        return self._first[first].value(self._clock()) / (OF_OTHERS if first == OTHERS else 1 / keys)


def _forget(parts: OrderedDict[str, _Part], now: float) -> list[str]:
    """Drop those who had nothing for long; they come first."""
    gone = []
    while parts:
        name = next(iter(parts))
        if now - parts[name].at < _FORGOTTEN_S:
            break
        del parts[name]
        gone.append(name)
    return gone


class Metered:
    """Middleware that has the loop's time measured that a request's answer takes, where its server wants to know.

    Parameters
    ----------
    app : ASGI app
    pacing : Pacing
        What such a server is lent.
    """

    def __init__(self, app: ASGIApp, pacing: Pacing) -> None:
        self._app = app
        self._pacing = pacing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" and "state" in scope:
            scope["state"][KEY] = self._pacing
        meter = scope["state"].get(METER) if scope["type"] == "http" and "state" in scope else None
        answer = self._app(scope, receive, send)
        await (answer if meter is None else _Steps(answer, meter))


class _Steps:
    """Awaits something, and tells of each of its steps how long the thread had it."""

    def __init__(self, awaited: Awaitable[None], took: Callable[[float], None]) -> None:
        self._awaited = awaited
        self._took = took

    def __await__(self) -> Generator[Any, Any, None]:
        steps = self._awaited.__await__()
        step: Callable[[], Any] = steps.__next__
        while True:
            began = time.thread_time()
            try:
                waits_for = step()
            except StopIteration:
                return
            finally:
                self._took(time.thread_time() - began)
            try:
                yield waits_for
            except GeneratorExit:
                steps.close()
                raise
            except BaseException as error:
                step = functools.partial(steps.throw, error)
            else:
                step = steps.__next__
