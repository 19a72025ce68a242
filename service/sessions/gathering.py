"""Teammates' messages, waiting for the ego's frame."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from robosac.answers import Distrust, Reason
from robosac.audit.events import Proof
from robosac.defenses import Rejection
from robosac.detectors import Message
from robosac.recording.truth import Truth
from service.errors import Draining, Kind, Refused, Unusable
from service.sessions.room import Share

REMEMBERED_FRAMES = 8
"""Answered frames for which a message that comes again is told from one that says something else."""

MOVED = "the session came to this gateway process with this frame; a message sent before may be lost with another"


@dataclass(frozen=True)
class Received:
    """A message that was checked, and what proves who said it."""

    message: Message
    digest: str
    """`robosac.wire.content_digest`."""
    signature: bytes | None = None
    key: str | None = None
    """The vehicle's registered key, base64, by which the signature was checked; None if it had none."""
    truth: Truth | None = None
    """What the ego tells for recordings."""
    at: float = field(default_factory=time.time, compare=False)
    """When it was read, Unix seconds."""

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
    room : Share
        What the session's messages may take of the room for those of all sessions.
    closed : int
        Frames up to this one are answered.
    moved : bool
        Whether messages for the next frame may have been sent to another process, and be lost.
    """

    def __init__(
        self, team: Sequence[str], max_ahead: int, room: Share, closed: int = -1, *, moved: bool = False
    ) -> None:
        self._pending: dict[str, dict[int, Received | None]] = {name: {} for name in team}
        self._said: dict[str, dict[int, Proof]] = {name: {} for name in team}
        self._refusals: dict[str, tuple[int | None, Rejection]] = {}
        self._max_ahead = max_ahead
        self._room = room
        self._closed = self._closed_before = closed
        self._set_aside: dict[str, tuple[int | None, Rejection]] = {}
        self._arrival = asyncio.Event()
        self._moved = moved
        self._sent_away = False

    @property
    def waits(self) -> bool:
        """Whether a message waits for a frame that is not answered."""
        return any(frame > self._closed for mine in self._pending.values() for frame in mine)

    def waiting_of(self, sender: str) -> list[int]:
        """Frames that are not answered, for which there is a message of a vehicle."""
        return sorted(frame for frame in self._said.get(sender, ()) if frame > self._closed)

    def send_away(self) -> None:
        """Let nobody wait for messages any more: this process is to end."""
        self._sent_away = True
        self._arrival.set()

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
        Refused
            If there is no room for it (``overloaded``).
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
            self._put(sender, frame, None)
            raise Contradiction(said)
        if frame <= self._closed:
            reason = Reason.LATE if frame == self._closed else Reason.STALE
            detail = f"frame {frame} is answered; the latest answered is {self._closed}"
            self.refuse(sender, frame, reason, detail)
            raise Unusable(Kind.STALE_FRAME, reason, detail)
        self._room.of(sender).check(received.nbytes)
        self._put(sender, frame, received)
        self._said[sender][frame] = received.proof
        if sum(later > self._closed for later in mine) > self._max_ahead + 1:
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

    async def collect(
        self, frame: int, until: float, each: Callable[[str, Message], None] = lambda *_: None
    ) -> dict[str, Received]:
        """Wait until every teammate's message for a frame is in, or the time (of `time.perf_counter`) has come.

        ``each`` is told of every message as soon as it is in.

        Returns
        -------
        dict of teammate to Received
            Those that are in, and count.

        Raises
        ------
        Refused
            If the process is to end before (``draining``): the messages are sent to another then, and have to meet the
            ego's there.
        """
        told: set[str] = set()
        with suppress(TimeoutError):
            async with asyncio.timeout(until - time.perf_counter()):
                while not self._sent_away and any(frame not in mine for mine in self._pending.values()):
                    for name, mine in self._pending.items():
                        if name not in told and (received := mine.get(frame)) is not None:
                            told.add(name)
                            each(name, received.message)
                    self._arrival.clear()
                    await self._arrival.wait()
        if self._sent_away and any(frame not in mine for mine in self._pending.values()):
            raise Draining
        waiting = {name: mine.get(frame) for name, mine in self._pending.items()}
        return {name: received for name, received in waiting.items() if received is not None}

    def absence(self, teammate: str, frame: int) -> Rejection:
        """Why there is no message of a teammate for a frame."""
        if self._pending.get(teammate, {}).get(frame, ...) is None:
            detail = "it sent different messages for this frame"
            return Rejection(Reason.DISTRUSTED, {"detail": detail}, Distrust.EQUIVOCATION)
        missing = Rejection(Reason.MISSING, {"detail": MOVED} if self._moved else {})
        refused_for, rejection = self._refusals.get(teammate, (None, missing))
        return rejection if refused_for is None or refused_for <= frame else missing

    def change_team(self, team: Sequence[str]) -> None:
        """Keep what those who stay have sent, and forget those who left."""
        for leaver in set(self._pending) - set(team):
            self._forget(leaver, list(self._pending[leaver]))
        self._pending = {name: self._pending.get(name, {}) for name in team}
        self._said = {name: self._said.get(name, {}) for name in team}
        self._refusals = {name: refusal for name, refusal in self._refusals.items() if name in self._pending}

    def begin(self, frame: int) -> None:
        """A frame is being decided: what comes for it from now on is late, what is in stays until `close`."""
        if frame > self._closed:
            self._closed_before, self._closed = self._closed, frame
            self._set_refusals_aside(frame)

    def reopen(self, frame: int) -> None:
        """The frame in hand was not kept after all: it can be asked for again, and its messages are still there."""
        if self._closed == frame:
            self._closed = self._closed_before
            self._refusals = self._set_aside | self._refusals

    def close(self, frame: int) -> None:
        """A frame is answered: it and all before it are over."""
        if frame > self._closed:
            self._set_refusals_aside(frame)
        self._closed = frame
        self._moved = False
        self._set_aside = {}
        for name, mine in self._pending.items():
            self._forget(name, [f for f in mine if f <= frame])
            said = self._said[name]
            for old in [f for f in said if f <= frame - REMEMBERED_FRAMES]:
                del said[old]

    def clear(self) -> None:
        """Let go of everything."""
        self.change_team(())

    def _set_refusals_aside(self, frame: int) -> None:
        """Let those count no more that were for a frame up to this one."""
        later = {name: told for name, told in self._refusals.items() if told[0] is not None and told[0] > frame}
        self._set_aside = {name: told for name, told in self._refusals.items() if name not in later}
        self._refusals = later

    def _put(self, sender: str, frame: int, received: Received | None) -> None:
        mine = self._pending[sender]
        before = mine.get(frame)
        if received is None and frame <= self._closed and frame not in mine:
            return
        mine[frame] = received
        self._room.of(sender).add((received.nbytes if received else 0) - (before.nbytes if before else 0))

    def _drop(self, sender: str, frame: int) -> None:
        dropped = self._pending[sender].pop(frame)
        if dropped is not None:
            self._room.of(sender).add(-dropped.nbytes)

    def _forget(self, sender: str, frames: Sequence[int]) -> None:
        for frame in frames:
            self._drop(sender, frame)
