"""Teammates' messages, waiting for the ego's frame."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from robosac.answers import Distrust, Reason
from robosac.audit.events import Proof
from robosac.defenses import Rejection
from robosac.detectors import Message
from service.errors import Kind, Refused, Unusable

REMEMBERED_FRAMES = 8
"""Answered frames for which a message that comes again is told from one that says something else."""


@dataclass(frozen=True)
class Received:
    """A message that was checked, and what proves who said it."""

    message: Message
    digest: str
    """`robosac.wire.content_digest`."""
    signature: bytes | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of its tensors."""
        return sum(tensor.nbytes for tensor in self.message.tensors.values())

    @property
    def proof(self) -> Proof:
        """What the audit log says of it."""
        return Proof(digest=self.digest, signature=self.signature)


class Contradiction(Refused):
    """A vehicle said two different things about one frame; ``first`` proves what it said before."""

    def __init__(self, first: Proof) -> None:
        super().__init__(
            Kind.EQUIVOCATION, "another message with other content came for this frame; neither is used", "frame"
        )
        self.first = first


class Backlog:
    """Bytes of all messages that wait, of all sessions, and the most that they may be."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0

    @property
    def full(self) -> bool:
        """Whether no more may be kept."""
        return self.nbytes >= self.limit


class Gathering:
    """Collects one message per teammate and frame.

    What one teammate sends takes only its own places: its message for the frame in hand and at most ``max_ahead`` for
    later ones. Of more, the farthest ahead are dropped, so that a sender of absurd frame numbers hurts nobody, itself
    included. A teammate that says two different things about a frame is not heard in it.

    Parameters
    ----------
    team : sequence of str
        Enrolled teammates.
    max_ahead : int
        Frames kept per teammate besides the next.
    backlog : Backlog
        Shared by all sessions.
    closed : int
        Frames up to this one are answered.
    """

    def __init__(self, team: Sequence[str], max_ahead: int, backlog: Backlog, closed: int = -1) -> None:
        self._pending: dict[str, dict[int, Received | None]] = {name: {} for name in team}
        self._said: dict[str, dict[int, Proof]] = {name: {} for name in team}
        self._refusals: dict[str, tuple[int | None, Rejection]] = {}
        self._max_ahead = max_ahead
        self._backlog = backlog
        self._closed = closed
        self._arrival = asyncio.Event()

    @property
    def closed(self) -> int:
        """The latest frame that is answered, or being answered; -1 before the first."""
        return self._closed

    def offer(self, frame: int, sender: str, received: Received) -> None:
        """Keep a message for its frame.

        Raises
        ------
        Unusable
            If the sender's message for the frame is in (``replayed``), the frame is answered already (``late`` for the
            latest, ``stale`` for an earlier one), it is farther ahead than all that are kept (``malformed``), or the
            sender has left meanwhile (``unauthenticated``).
        Contradiction
            If the sender said something else about the frame before.
        """
        mine = self._pending.get(sender)
        if mine is None:
            raise Unusable(Kind.NOT_ENROLLED, Reason.UNAUTHENTICATED, f"{sender} has left the session")
        said = self._said[sender].get(frame)
        if said is not None:
            if said.digest == received.digest:
                detail = f"this message of {sender} for frame {frame} is in already"
                if frame <= self._closed:
                    self.refuse(sender, frame, Reason.REPLAYED, detail)
                raise Unusable(Kind.DUPLICATE_MESSAGE, Reason.REPLAYED, detail)
            self._put(mine, frame, None)
            raise Contradiction(said)
        if frame <= self._closed:
            reason = Reason.LATE if frame == self._closed else Reason.STALE
            detail = f"frame {frame} is answered; the latest answered is {self._closed}"
            self.refuse(sender, frame, reason, detail)
            raise Unusable(Kind.STALE_FRAME, reason, detail)
        self._put(mine, frame, received)
        self._said[sender][frame] = received.proof
        if len(mine) > self._max_ahead + 1:
            farthest = max(mine)
            self._drop(sender, farthest)
            del self._said[sender][farthest]
            if frame == farthest:
                detail = f"frame {frame} is too far ahead; {self._max_ahead} are kept"
                raise Unusable(Kind.TOO_FAR_AHEAD, Reason.MALFORMED, detail)
        self._arrival.set()

    def refuse(self, sender: str, frame: int | None, reason: Reason, detail: str) -> None:
        """Remember why a sender's message does not count, for the result of the first frame that it could be for."""
        self._refusals[sender] = (frame, Rejection(reason, {"detail": detail}))

    async def collect(self, frame: int, until: float) -> dict[str, Received]:
        """Wait until every teammate's message for a frame is in, or the time (of `time.perf_counter`) has come.

        Returns
        -------
        dict of teammate to Received
            Those that are in, and count.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(until - time.perf_counter()):
                while any(frame not in mine for mine in self._pending.values()):
                    self._arrival.clear()
                    await self._arrival.wait()
        waiting = {name: mine.get(frame) for name, mine in self._pending.items()}
        return {name: received for name, received in waiting.items() if received is not None}

    def absence(self, teammate: str, frame: int) -> Rejection:
        """Why there is no message of a teammate for a frame."""
        if self._pending[teammate].get(frame, ...) is None:
            detail = "it sent different messages for this frame"
            return Rejection(Reason.DISTRUSTED, {"detail": detail}, Distrust.EQUIVOCATION)
        refused_for, rejection = self._refusals.get(teammate, (None, Rejection(Reason.MISSING)))
        return rejection if refused_for is None or refused_for <= frame else Rejection(Reason.MISSING)

    def change_team(self, team: Sequence[str]) -> None:
        """Keep what those who stay have sent, and forget those who left."""
        for leaver in set(self._pending) - set(team):
            self._forget(leaver, list(self._pending[leaver]))
        self._pending = {name: self._pending.get(name, {}) for name in team}
        self._said = {name: self._said.get(name, {}) for name in team}
        self._refusals = {name: refusal for name, refusal in self._refusals.items() if name in self._pending}

    def close(self, frame: int) -> None:
        """A frame is being answered: it and all before it are over."""
        self._closed = frame
        self._refusals = {
            name: (refused_for, rejection)
            for name, (refused_for, rejection) in self._refusals.items()
            if refused_for is not None and refused_for > frame
        }
        for name, mine in self._pending.items():
            self._forget(name, [f for f in mine if f <= frame])
            said = self._said[name]
            for old in [f for f in said if f <= frame - REMEMBERED_FRAMES]:
                del said[old]

    def clear(self) -> None:
        """Let go of everything."""
        self.change_team(())

    def _put(self, mine: dict[int, Received | None], frame: int, received: Received | None) -> None:
        before = mine.get(frame)
        if received is None and frame <= self._closed:
            return
        mine[frame] = received
        self._backlog.nbytes += (received.nbytes if received else 0) - (before.nbytes if before else 0)

    def _drop(self, sender: str, frame: int) -> None:
        dropped = self._pending[sender].pop(frame)
        self._backlog.nbytes -= dropped.nbytes if dropped else 0

    def _forget(self, sender: str, frames: Sequence[int]) -> None:
        for frame in frames:
            self._drop(sender, frame)
