"""Whatever is asked for gives way to frames, however much of it there is."""

from __future__ import annotations

import asyncio
import re
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.arriving.paths import path_of

AT_A_TIME = 2
"""Requests that are answered at a time."""
EVERY_S = 0.05
"""How often one begins while frames are in hand."""
TURN_S = 0.25
"""After which a request that still waits for its client, or the database, holds up no other."""
_LOOK_S = 0.004
"""How often it is looked whether frames are in hand."""
_NEVER_WAIT = re.compile(r"/healthz|/v1/live/.*")
_OF_VEHICLES = re.compile(r"/v1/sessions/([^/]+)/(?:frames|messages|standby)")


Party = tuple[str, ...]
"""Who has the same number of turns as any other, then who of theirs asks, who has as many as the others of theirs, and
so on.
"""


class Turn:
    """The place of a request among those that wait, and then its turn."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self.began: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._end: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """It may go on."""
        self.began.set_result(None)
        self._end = asyncio.get_running_loop().call_later(self._line.turn_s, self.end)

    def end(self) -> None:
        """Let the next one begin; again and again does no harm."""
        if self._end is not None:
            self._end.cancel()
            self._end = None
            self._line.ended()


@dataclass
class Waiting:
    """Those of a party that wait: its own, and those of its members by turns."""

    own: deque[Turn] = field(default_factory=deque)
    members: OrderedDict[str, Waiting] = field(default_factory=OrderedDict)

    def __bool__(self) -> bool:
        return bool(self.own or self.members)

    def put(self, turn: Turn, party: Party) -> None:
        if party:
            self.members.setdefault(party[0], Waiting()).put(turn, party[1:])
        else:
            self.own.append(turn)

    def take(self, *names: str) -> Turn:
        """The next one; of the member of this name, of its member of the next, and so on, as far as names are given."""
        if self.own and not names:
            return self.own.popleft()
        name = names[0] if names else next(iter(self.members))
        member = self.members.pop(name)
        turn = member.take(*names[1:])
        if member:
            self.members[name] = member  # behind the others
        return turn


class Line:
    """Requests that wait: the parties' by turns, of a party its members' by turns, and of one without members in the
    order in which they came.

    Parameters
    ----------
    busy : callable
        Whether frames are in hand.
    at_a_time : int
        Requests that have a turn at a time.
    turn_s : float
        After which a request holds up no other, even if its turn is not over.
    """

    def __init__(self, busy: Callable[[], bool], at_a_time: int = AT_A_TIME, turn_s: float = TURN_S) -> None:
        self.turn_s = turn_s
        self._busy = busy
        self._at_most = at_a_time
        self._waiting = Waiting()
        self._at_work = 0
        self._latest = -1.0
        self._look: asyncio.TimerHandle | None = None

    async def turn(self, party: Party) -> Turn:
        """A turn of a party, once it has come."""
        turn = Turn(self)
        self._waiting.put(turn, party)
        self._go_on()
        try:
            await turn.began
        except asyncio.CancelledError:
            turn.end()
            raise
        return turn

    def ended(self) -> None:
        """A turn is over."""
        self._at_work -= 1
        self._go_on()

    def _go_on(self) -> None:
        while self._waiting and self._at_work < self._at_most:
            now = time.perf_counter()
            if self._busy() and now < self._latest + EVERY_S:
                self._look_later()
                return
            turn = self._take(self._waiting)
            if turn is None:
                self._look_later()
                return
            if not turn.began.done():  # it was not given up
                self._latest = now
                self._at_work += 1
                turn.begin()

    def _take(self, waiting: Waiting) -> Turn | None:
        """Whose turn it is of those that wait; None if nobody's yet."""
        return waiting.take()

    def _look_later(self) -> None:
        if self._look is None:
            self._look = asyncio.get_running_loop().call_later(_LOOK_S, self._look_again)

    def _look_again(self) -> None:
        self._look = None
        self._go_on()


class GivesWay:
    """Middleware that lets requests other than vehicles' frames and messages in by turns: few at a time, and seldom
    while frames are in hand. So nobody's openings, logs, pages or mistakes take the time that frames need, and no
    stranger's frames. Parties have the same number of turns (`service.arriving.parties`). An answer in parts gives way
    after each.

    Parameters
    ----------
    app : ASGI app
    line : Line
    party_of : callable
        Of a request.
    is_vehicle : callable
        Whether a request shows a token that was made for the session with this id. No database may be asked for it.
    """

    def __init__(
        self,
        app: ASGIApp,
        line: Line,
        party_of: Callable[[Scope], Party],
        is_vehicle: Callable[[Scope, str], bool],
    ) -> None:
        self._app = app
        self._line = line
        self._party_of = party_of
        self._is_vehicle = is_vehicle

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or self._never_waits(scope):
            await self._app(scope, receive, send)
            return
        party = self._party_of(scope)
        turn = await self._line.turn(party)

        async def in_parts(message: Message) -> None:
            nonlocal turn
            if not message.get("more_body", False):
                await send(message)
                return
            turn.end()
            await send(message)
            turn = await self._line.turn(party)

        try:
            await self._app(scope, receive, in_parts)
        finally:
            turn.end()

    def _never_waits(self, scope: Scope) -> bool:
        path = path_of(scope)
        found = _OF_VEHICLES.fullmatch(path)
        return self._is_vehicle(scope, found[1]) if found else _NEVER_WAIT.fullmatch(path) is not None
