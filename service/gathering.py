"""Teammates' messages, waiting for the ego's frame."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from robosac.defenses import Reason, Rejection
from robosac.detectors import Message


class Refused(Exception):
    """A message that is well-formed but cannot be kept."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail


class Gathering:
    """Collects one message per teammate and frame.

    What one teammate sends takes only its own places: at most ``max_pending`` frames ahead, the oldest making way for
    the newest, so that a sender of absurd frame numbers hurts nobody else.

    Parameters
    ----------
    team : sequence of str
        Enrolled teammates.
    max_pending : int
        Frames kept per teammate.
    closed : int
        Frames up to this one are answered.
    """

    def __init__(self, team: Sequence[str], max_pending: int, closed: int = -1) -> None:
        self._pending: dict[str, dict[int, Message]] = {name: {} for name in team}
        self._refusals: dict[str, Rejection] = {}
        self._max_pending = max_pending
        self._closed = closed
        self._arrival = asyncio.Event()

    def offer(self, frame: int, sender: str, message: Message) -> None:
        """Keep a message for its frame.

        Raises
        ------
        Refused
            If the frame is answered already (``late`` for the latest, ``stale`` for an earlier one), or the sender's
            message for it is in (``replayed``).
        """
        if frame <= self._closed:
            reason = Reason.LATE if frame == self._closed else Reason.STALE
            detail = f"frame {frame} is answered; the latest answered is {self._closed}"
            self.refuse(sender, reason, detail)
            raise Refused(reason, detail)
        mine = self._pending[sender]
        if frame in mine:
            raise Refused(
                Reason.REPLAYED, f"a message of {sender} for frame {frame} is in already; the first one counts"
            )
        mine[frame] = message
        if len(mine) > self._max_pending:
            del mine[min(mine)]
        self._arrival.set()

    def refuse(self, sender: str, reason: Reason, detail: str) -> None:
        """Remember why a sender's latest message does not count, for the result of the next frame that lacks it."""
        self._refusals[sender] = Rejection(reason, {"detail": detail})

    async def collect(self, frame: int, until: float) -> tuple[dict[str, Message], dict[str, Rejection]]:
        """Wait until every teammate's message for a frame is in, or the time (of `time.perf_counter`) has come.

        Returns
        -------
        messages : dict of teammate to Message
        absent : dict of teammate to Rejection
            Why each of the others is not there.
        """
        while any(frame not in mine for mine in self._pending.values()):
            self._arrival.clear()
            remaining = until - time.perf_counter()
            if remaining <= 0:
                break
            try:
                await asyncio.wait_for(self._arrival.wait(), remaining)
            except TimeoutError:
                break
        messages = {name: mine[frame] for name, mine in self._pending.items() if frame in mine}
        absent = {name: self.absence(name) for name in self._pending if name not in messages}
        return messages, absent

    def absence(self, teammate: str) -> Rejection:
        """Why there is no message of a teammate."""
        return self._refusals.get(teammate, Rejection(Reason.MISSING))

    def close(self, frame: int) -> None:
        """A frame is being answered: it and all before it are over."""
        self._closed = frame
        self._refusals.clear()
        for mine in self._pending.values():
            for old in [f for f in mine if f <= frame]:
                del mine[old]
