"""Sessions that nobody uses any more, at this gateway or at another on the same store."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from service.keeping.store import Store
from service.sessions.clock import Clock
from service.sessions.live import LiveSession

SWEEP_EVERY_S = 30.0
NOTED_TOGETHER = 64


@dataclass(frozen=True)
class Idle:
    """Finds the sessions that were unused for longer than ``idle_s``; ``live`` are those in use here.

    Some uses add nothing to a session in the store, as where its state is read or a message waits. Only the process
    that saw them knows of them; so each tells the store of its own, and has the time of two sweeps for it.
    """

    store: Store
    live: Mapping[str, LiveSession]
    idle_s: float
    clock: Clock

    @property
    def every_s(self) -> float:
        """Time from one sweep to the next."""
        return min(SWEEP_EVERY_S, self.idle_s / 4)

    async def unused(self) -> list[str]:
        """Sessions that nobody has used for too long, once the store knows of what was used here."""
        now = time.time() - await self.store.ahead_s()
        quiet = [one for one in await self.store.unused_since(now - self.idle_s / 2) if one in self.live]
        used = sorted((one, now - age_s) for one in quiet if (age_s := self._unused_s(one)) < self.idle_s / 2)
        for first in range(0, len(used), NOTED_TOGETHER):  # few at a time, since decisions wait for the database, too
            await self.store.touch(dict(used[first : first + NOTED_TOGETHER]))
        return [one for one in await self.store.unused_since(self.long_ago()) if self.is_unused_here(one)]

    def long_ago(self) -> float:
        """The moment since which a session must have been used, as the store knows it, to go on (Unix time)."""
        unused_s = self.idle_s + 2 * self.every_s
        return time.time() - unused_s - self.clock.stepped_s(unused_s)

    def is_unused_here(self, session_id: str) -> bool:
        """Whether nobody has used a session here for too long."""
        return self._unused_s(session_id) > self.idle_s

    def may_be_over(self, session_id: str) -> bool:
        """Whether what is held of a session may be of no use here any more."""
        live = self.live.get(session_id)
        return live is None or live.is_quiet or self.is_unused_here(session_id)

    def _unused_s(self, session_id: str) -> float:
        """For how long nobody has used a session here; for ever, if it is not in use here."""
        live = self.live.get(session_id)
        if live is None:
            return float("inf")
        return 0.0 if live.lock.locked() else time.monotonic() - live.last_used
