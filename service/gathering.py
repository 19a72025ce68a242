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

    What one teammate sends takes only its own places: its message for the frame in hand and at most ``max_ahead`` for
    later ones. Of more, the farthest ahead are dropped, so that a sender of absurd frame numbers hurts nobody, itself
    included.

    Parameters
    ----------
    team : sequence of str
        Enrolled teammates.
    max_ahead : int
        Frames kept per teammate besides the next.
    closed : int
        Frames up to this one are answered.
    """

    def __init__(self, team: Sequence[str], max_ahead: int, closed: int = -1) -> None:
        self._pending: dict[str, dict[int, Message]] = {name: {} for name in team}
        self._refusals: dict[str, tuple[int | None, Rejection]] = {}
        self._max_ahead = max_ahead
        self._closed = closed
        self._arrival = asyncio.Event()

    def offer(self, frame: int, sender: str, message: Message) -> None:
        """Keep a message for its frame.

        Raises
        ------
        Refused
            If the frame is answered already (``late`` for the latest, ``stale`` for an earlier one), the sender's
            message for it is in (``replayed``), it is farther ahead than all that are kept (``malformed``), or the
            sender has left meanwhile (``unauthenticated``).
        """
        mine = self._pending.get(sender)
        if mine is None:
            raise Refused(Reason.UNAUTHENTICATED, f"{sender} has left the session")
        if frame <= self._closed:
            reason = Reason.LATE if frame == self._closed else Reason.STALE
            detail = f"frame {frame} is answered; the latest answered is {self._closed}"
            self.refuse(sender, frame, reason, detail)
            raise Refused(reason, detail)
        if frame in mine:
            raise Refused(Reason.REPLAYED, f"a message of {sender} for frame {frame} is in; the first one counts")
        mine[frame] = message
        if len(mine) > self._max_ahead + 1:
            del mine[max(mine)]
            if frame not in mine:
                raise Refused(Reason.MALFORMED, f"frame {frame} is too far ahead; {self._max_ahead} are kept")
        self._arrival.set()

    def refuse(self, sender: str, frame: int | None, reason: Reason, detail: str) -> None:
        """Remember why a sender's message does not count, for the result of the first frame that it could be for."""
        self._refusals[sender] = (frame, Rejection(reason, {"detail": detail}))

    async def collect(self, frame: int, until: float) -> dict[str, Message]:
        """Wait until every teammate's message for a frame is in, or the time (of `time.perf_counter`) has come.

        Returns
        -------
        dict of teammate to Message
            Those that are in.
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
        return {name: mine[frame] for name, mine in self._pending.items() if frame in mine}

    def absence(self, teammate: str, frame: int) -> Rejection:
        """Why there is no message of a teammate for a frame."""
        refused_for, rejection = self._refusals.get(teammate, (None, Rejection(Reason.MISSING)))
        return rejection if refused_for is None or refused_for <= frame else Rejection(Reason.MISSING)

    def change_team(self, team: Sequence[str]) -> None:
        """Keep what those who stay have sent, and forget those who left."""
        self._pending = {name: self._pending.get(name, {}) for name in team}
        self._refusals = {name: refusal for name, refusal in self._refusals.items() if name in self._pending}

    def close(self, frame: int) -> None:
        """A frame is being answered: it and all before it are over."""
        self._closed = frame
        self._refusals = {
            name: (refused_for, rejection)
            for name, (refused_for, rejection) in self._refusals.items()
            if refused_for is not None and refused_for > frame
        }
        for mine in self._pending.values():
            for old in [f for f in mine if f <= frame]:
                del mine[old]
