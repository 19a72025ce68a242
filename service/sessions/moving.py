"""Sessions that move from one gateway process to another: by whom one is held, and what waits for its vehicles to hear.

The store keeps all of a session but the messages that wait for a frame. A vehicle that stands by hears when they may be
lost, because its stream ends, and sends them again where the session is now.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import socket
import time
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from service.errors import Draining, Refused
from service.keeping.patience import within
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.sessions.live import Caller, LiveSession, Standing

LOOK_EVERY_S = 0.03
"""How often it is looked, while messages wait and the ego does not ask, whether it asks elsewhere."""
LOOK_FOR_S = 1.0
"""And how long, after the latest message."""
SILENCE_S = 15.0
"""After so long a vehicle that stands by is told that there is no news."""


def _name() -> str:
    return f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"


@dataclass
class Moving:
    """What this process tells others, and its vehicles, of the sessions that it holds.

    ``name`` is this process's: of its machine, its number and chance, and no other ever had it. The store has it as the
    holder of a session, and the audit log beside each decision.
    """

    store: Store
    name: str = field(default_factory=_name)
    draining: bool = False
    """Whether this process is to end, and takes nothing new."""
    looking: asyncio.Task[None] | None = None
    _watched: dict[str, LiveSession] = field(default_factory=dict)

    def check_open(self) -> None:
        """Refuse whatever is new in a process that is to end.

        Raises
        ------
        Refused
            With the kind ``draining``: nothing was done, and another process does it.
        """
        if self.draining:
            raise Draining

    def drain(self, sessions: Iterable[LiveSession]) -> None:
        """Take nothing new from now on. Frames that are being decided go on; those that wait are asked for again."""
        self.draining = True
        for live in sessions:
            live.gathering.send_away()
            live.send_away()

    async def hold(self, caller: Caller, until: float) -> None:
        """The ego asks here: say so in the store if it asked elsewhere before, at most until then
        (`time.perf_counter`). A store that fails now fails the decision, too.
        """
        caller.live.held = True
        if caller.record.holder != self.name:  # or it is not known
            saying = self.store.hold(caller.record.session_id, self.name)
            with contextlib.suppress(TimeoutError, Refused):
                await within(saying, max(until - time.perf_counter(), 0.0))

    def is_elsewhere(self, record: SessionRecord) -> bool:
        """Whether the session's ego asks another process."""
        return record.holder not in ("", self.name)

    @contextlib.contextmanager
    def standing_by(self, caller: Caller) -> Iterator[Standing]:
        """A vehicle stands by for the length of a block, in the place of its own earlier stream if it has one."""
        standing, all_of_them = Standing(), caller.live.standing
        if (before := all_of_them.get(caller.vehicle_id)) is not None:
            before.over.set()
        all_of_them[caller.vehicle_id] = standing
        if self.draining:
            standing.over.set()
        try:
            yield standing
        finally:
            if all_of_them.get(caller.vehicle_id) is standing:
                del all_of_them[caller.vehicle_id]

    def known(self, caller: Caller) -> dict[str, Any]:
        """What a vehicle that stands by is told first: which frames are answered, and which of its messages wait."""
        gathering = caller.live.gathering
        waiting = gathering.waiting_of(caller.vehicle_id)
        return {"gateway": self.name, "answered": gathering.closed, "waiting": waiting}

    def message_waits(self, caller: Caller) -> None:
        """A message was kept: as long as it waits, look whether the session has moved away."""
        live = caller.live
        live.looked_for = time.monotonic() + LOOK_FOR_S
        if live.held and live.standing:
            self._watched[caller.record.session_id] = live
            if self.looking is None:
                self.looking = asyncio.create_task(self._look())

    async def _look(self) -> None:
        """One question at a time for all sessions: a database that is busy already is not asked more."""
        try:
            while self._watched:
                await asyncio.sleep(LOOK_EVERY_S)
                for session_id in [key for key, live in self._watched.items() if not _is_looked_for(live)]:
                    del self._watched[session_id]
                with contextlib.suppress(Refused):  # the database fails: nobody can decide now, here or elsewhere
                    holders = await self.store.holders(list(self._watched))
                    for session_id in [key for key, holder in holders.items() if holder != self.name]:
                        self._watched.pop(session_id).send_away()
        finally:
            self.looking = None


def _is_looked_for(live: LiveSession) -> bool:
    soon = time.monotonic() < live.looked_for
    return soon and bool(live.standing) and live.gathering.waits and not live.lock.locked()


async def news(standing: Standing, silence_s: float = SILENCE_S) -> AsyncIterator[None]:
    """A turn each time that there was nothing to tell for a while, until the stream is over."""
    while not standing.over.is_set():
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(silence_s):
                await standing.over.wait()
        if not standing.over.is_set():
            yield
