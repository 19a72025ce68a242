"""The event loop's time, shared by those who send: whoever took more than the others lately is read from later.

What comes costs time before anybody can say what it is worth: connections, heads, pieces of bodies, refusals. So it
is measured what the loop does for each connection and its requests, and once the loop is short of time, nothing more is
read from those who had most. What was read of them last is kept, and the rest waits in the kernel.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Protocol

from starlette.types import Scope

KEY = "robosac_pacing"
"""In the state that the lifespan shares with servers."""
OTHERS = "others"
"""The first part of the party of whoever shows no credential that counts."""
Party = tuple[str, ...]
"""A key, a session of it and a vehicle of that; a key, and nothing for its own requests; viewers, and which of them; or
`OTHERS` and an address.
"""

LATELY_S = 0.05
"""What somebody had counts for about so long."""
LONG_S = 0.5
"""And for so long where it is asked who had more than others, since what a frame needs comes in a burst, and of many
each may have a little after the other.
"""
LIMIT, LIMIT_GREEDY = 0.5, 0.1
"""Part of the loop's time from which on it is short of time; and for whoever had much more than those whose frames are
wanted.
"""
SLACK = 2.0
"""How many equal parts somebody may have before it has to wait: those who all want as much are not held up by turns."""
OF_OTHERS = 0.25
"""Part of the limit that counts as the equal part of all who show no credential."""
MEMBERS_SLACK = 2.0
"""How many parts of a key its members may have together, of whom none had more than its own: each may be new."""
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

    def __init__(self, lately_s: float) -> None:
        self._lately_s = lately_s
        self._value, self.at = 0.0, -math.inf

    def add(self, seconds: float, now: float) -> None:
        self._value, self.at = self.value(now) + seconds / self._lately_s, now

    def value(self, now: float) -> float:
        return self._value * math.exp(min(0.0, self.at - now) / self._lately_s)


class _Had:
    """What somebody had of the time just now, and for longer; and for as long what its frames had of the detector's."""

    def __init__(self) -> None:
        self.now, self.long, self.worked = _Part(LATELY_S), _Part(LONG_S), _Part(LONG_S)

    def add(self, seconds: float, now: float) -> None:
        self.now.add(seconds, now)
        self.long.add(seconds, now)


class Pacing:
    """Knows what everybody had of the event loop's time lately, and whom it is to be kept from.

    That is whoever had more than `SLACK` equal parts of what there is (`LIMIT`) while all together had as much as that:
    equal parts for API keys, of a key's for its sessions, and of a session's for its vehicles; others have `OF_OTHERS`,
    and of that each address an equal part. Those of a key, a session or `OTHERS` all wait once they had `MEMBERS_SLACK`
    times their part together. Whoever had least of its part goes on first, its members by turns.

    While frames are wanted, there is less (`LIMIT_GREEDY`) for `OTHERS`, and, of keys that had more than `SLACK` times
    as much, for whoever had more than `SLACK` times what somebody had whose frames are wanted: the key than that key, a
    session than another of its key, and a vehicle than the others of its session on average. But not for whoever had
    less than its own frames had of the detector's time, of which they have a fair share: else somebody who sends little
    would keep those away who have many frames decided.

    Parameters
    ----------
    party_of : callable
        Of a request's scope.
    wanted_by : callable
        The sessions, as the first two parts of their parties, whose frames are in hand or begin to come; any of them
        more than once.
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        party_of: Callable[[Scope], Party],
        wanted_by: Callable[[], Iterable[Party]],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.party_of = party_of
        self._wanted_by = wanted_by
        self._clock = clock
        self._all = _Part(LATELY_S)
        self._had: OrderedDict[Party, _Had] = OrderedDict()
        """Of parties, and of each beginning of one; who had some last comes last."""
        self._members: Counter[Party] = Counter()
        """How many had some that begin so, and are one longer."""
        self._waiting: dict[str, OrderedDict[Party, deque[tuple[Paced, int]]]] = {}
        self._kept = 0
        self._look: asyncio.TimerHandle | None = None
        self._told_at_s = math.inf
        """Of the loop's thread, how much time it had had when it was last told who had it."""

    def had_since(self, party: Party) -> None:
        """Somebody had the loop's time since this was last called: nobody tells of what the loop does between what is
        somebody's, and most of that is to receive, and to send, for whoever comes next.
        """
        now_s = time.thread_time()
        since_s, self._told_at_s = now_s - self._told_at_s, now_s
        self.charge(party, max(since_s, 0.0))

    def charge(self, party: Party, seconds: float) -> None:
        """Somebody had so much of the loop's time."""
        now = self._clock()
        self._all.add(seconds, now)
        for length in range(1, len(party) + 1):
            of = party[:length]
            if of not in self._had:
                self._had[of] = _Had()
                self._members[of[:-1]] += 1
            self._had[of].add(seconds, now)
            self._had.move_to_end(of)
        self._forget(now)

    def worked(self, party: Party, seconds: float) -> None:
        """A frame of somebody had so much of the detector's time."""
        now = self._clock()
        for length in range(1, len(party) + 1):
            if (had := self._had.get(party[:length])) is not None:
                had.worked.add(seconds, now)

    def _forget(self, now: float) -> None:
        """Drop those who had nothing for long; they come first."""
        while self._had:
            of = next(iter(self._had))
            if now - self._had[of].now.at < _FORGOTTEN_S:
                break
            del self._had[of]
            self._members[of[:-1]] -= 1
            if not self._members[of[:-1]]:
                del self._members[of[:-1]]

    def is_over(self, party: Party) -> bool:
        """Whether the loop is short of time, and a party had more than its part of it."""
        now = self._clock()
        of_all = self._all.value(now)
        if of_all < LIMIT_GREEDY:
            return False
        limit = LIMIT_GREEDY if self._is_greedy(party, now) else LIMIT
        if of_all < limit:
            return False
        part = SLACK * limit * (OF_OTHERS if party[0] == OTHERS else 1 / self._keys())
        for length in range(1, len(party) + 1):
            had = self._had.get(party[:length])
            if had is None:
                return False
            lately = had.now.value(now)
            if max(lately, had.long.value(now) if length > 1 else 0.0) <= part:
                return False
            if lately > MEMBERS_SLACK * part:
                return True
            part /= self._members[party[:length]] or 1
        return True

    def _keys(self) -> int:
        return max(self._members[()] - ((OTHERS,) in self._had), 1)

    def _is_greedy(self, party: Party, now: float) -> bool:
        wanted = self._wanted_by()
        if party[0] == OTHERS:
            return any(True for _ in wanted)
        if self._long(party[:1], now) <= SLACK * LIMIT_GREEDY:
            return False
        return any(self._had_much_more(party, other, now) for other in wanted)

    def _had_much_more(self, party: Party, other: Party, now: float) -> bool:
        """Whether a party had more than `SLACK` times what a session had, both of them as far as they differ."""
        length = 1
        while length <= len(party) and party[:length] == other[:length]:
            length += 1
        mine = self._had.get(party[:length])
        if length > len(party) or mine is None:
            return False
        of_mine, of_theirs = mine.long.value(now), self._long(other[:length], now)
        if of_mine <= mine.worked.value(now):
            return False
        if length > len(other):  # it is one of their vehicles
            others = self._members[other] - 1
            of_theirs = (of_theirs - of_mine) / others if others else of_mine
        return of_mine > SLACK * of_theirs

    def _long(self, of: Party, now: float) -> float:
        return self._had[of].long.value(now) if of in self._had else 0.0

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
        first, *member = connection.party
        self._waiting.setdefault(first, OrderedDict()).setdefault(tuple(member), deque()).append((connection, kept))
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
            if self.is_over((first, *member)):
                members.move_to_end(member)
            elif (one := self._next_of(first, member)) is not None:
                one.go_on(self)
            if not members or self._clock() > until:
                break

    def _next_of(self, first: str, member: Party) -> Paced | None:
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
        had = self._had[(first,)].now.value(self._clock()) if (first,) in self._had else 0.0
        return had / (OF_OTHERS if first == OTHERS else 1 / self._keys())
