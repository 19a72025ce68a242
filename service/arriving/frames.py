"""Frames that arrive: from bodies to messages that are checked, and to whoever answers them."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TypeVar

from robosac import wire
from robosac.answers import Reason
from robosac.steps import Steps, finished
from service.arriving.bodies import SMALL_BYTES
from service.arriving.checking import InFrame, read_frame, read_message, reason_of
from service.arriving.parties import Parties
from service.arriving.reading import Reading
from service.deciding.admission import Admission
from service.deciding.answering import Deciding
from service.deciding.asked import Answered, Asked
from service.errors import Kind, Refused, StoreTooSlow, StoreUnavailable, Unusable
from service.keeping.patience import GRACE_S
from service.keeping.record import SessionRecord
from service.schemas import Receipt
from service.sessions.gathering import Contradiction, Received
from service.sessions.live import Caller
from service.sessions.room import Share
from service.sessions.sessions import Sessions
from service.turns import Work
from service.watching.metrics import Metrics

T = TypeVar("T")
HungUp = Callable[[], Awaitable[None]]
"""Returns when whoever asked hangs up."""

SLACK_BYTES = 64 * 1024
"""What a message may have besides its tensors."""
LONG_S = 0.5
"""Of a wait for teammates' messages, which ends early if the ego hangs up: its next frame would wait behind it."""
_COMPRESSED = wire.ZSTD.encode()
"""In a body of which much may come, however small it is."""


@dataclass(frozen=True)
class Frames:
    """Takes messages and whole frames in, and has them answered."""

    sessions: Sessions
    deciding: Deciding
    metrics: Metrics
    admission: Admission
    max_jump: int
    """By how much a frame's number may exceed the latest answered one."""
    reading: Reading

    async def post_message(
        self, caller: Caller, body: bytes, arrived: float, room: Share, hung_up: HungUp
    ) -> Answered | Receipt:
        """A vehicle's own message, whose request came then: kept for a teammate, answered for the ego.

        ``room`` is that of bodies, in which this one is counted as it came; ``hung_up`` ends when its sender hangs up.
        """
        frame, received = await self._read(caller, body, read_message)
        if not caller.is_ego:
            record = await self._keep(caller, frame, received)
            return Receipt(frame=frame, vehicle_id=caller.vehicle_id, receipt=self.sessions.keys.receipt(record))
        asked = Asked(caller, frame, received, arrived)
        asked.spent("receive", arrived)
        with self.admission.waiting(caller.record.session_id), room.holding(_expanded_by(asked, body)):
            return await self._answer(asked, hung_up)

    async def post_frame(self, caller: Caller, body: bytes, arrived: float, room: Share, expected: Work) -> Answered:
        """A whole frame from the ego, whose request came then. A teammate whose part is malformed is left out, and the
        frame is answered. ``room`` as for `post_message`, ``expected`` of `coming`.
        """
        frame, parts = await self._read(caller, body, read_frame)
        expected.over = True
        for name in parts.malformed:
            self.metrics.refused(parts.unusable[name].reason.value)
        asked = Asked(caller, frame, parts.ego, arrived, parts.messages, parts.unusable, whole=True)
        asked.spent("receive", arrived)
        with self.admission.waiting(caller.record.session_id), room.holding(_expanded_by(asked, body)):
            return await self._answer(asked)

    def coming(self, caller: Caller, arrived: float) -> AbstractContextManager[Work]:
        """As `service.deciding.admission.Admission.coming`, for an ego's frame whose request came then."""
        return self.admission.coming(caller.live.key, caller.record.session_id, arrived + caller.live.budget_s)

    def check_waiting(self, caller: Caller) -> None:
        """Refuse one frame of an ego too many before its body is read. It counts only once it is read and checked, so
        that nobody without the ego's key fills its places.
        """
        if caller.is_ego:
            self.admission.check_waiting(caller.record.session_id)

    def body_limit(self, caller: Caller, *, whole_frame: bool) -> int:
        """Bytes that a message, or a whole frame, of a session's detector may have."""
        tensors = caller.live.detector.info.tensors
        sizes = {role: sum(spec.nbytes for spec in specs.values()) + SLACK_BYTES for role, specs in tensors.items()}
        return sizes["ego"] + len(caller.record.teammates) * sizes["teammate"] if whole_frame else sizes[caller.role]

    async def refuse(self, caller: Caller, error: wire.WireError | Refused, frame: int | None = None) -> None:
        """Record a message that does not count; ``frame`` is the one that it was for, if that is known."""
        reason = reason_of(error)
        if not caller.is_ego:
            caller.live.gathering.refuse(caller.vehicle_id, frame, reason, error.detail)
        await self.sessions.journal.refusal(caller, reason, error.detail, frame, error.field or "")

    async def _read(self, caller: Caller, body: bytes, read: Callable[[Caller, bytes], Steps[T]]) -> T:
        """What a body holds, read off the event loop where that takes long; a refusal goes on record."""
        steps = read(caller, body)
        self.admission.expect(caller.live.key, caller.record.session_id)
        try:
            if len(body) <= SMALL_BYTES and _COMPRESSED not in body:
                return finished(steps)
            return await self.reading.read(caller, steps)
        except InFrame as error:
            await self.refuse(caller, error.what, error.frame)
            raise error.what from error.what.__cause__

    async def _answer(self, asked: Asked, hung_up: HungUp | None = None) -> Answered:
        """The answer to a frame; one that came as the ego's message alone, whose sender may hang up, is gathered."""
        caller, session_id = asked.caller, asked.caller.record.session_id
        try:
            async with _its_turn(asked):
                await self._check_ego_on_record(asked)
                if hung_up is not None:
                    began, until = time.perf_counter(), asked.arrived + caller.record.gather_ms / 1e3
                    await self.sessions.moving.hold(caller, until)
                    asked.messages = await self._gathered(asked, until, hung_up)
                    asked.spent("gather", began)
                with self.admission.frame(caller.live.key, session_id, asked.due, caller.live.budget_s) as work:
                    try:
                        return await self.deciding.answer(asked, work)
                    finally:
                        self.reading.pacing.worked(Parties.of_token(caller.record, caller.vehicle_id), work.had_s)
        except (StoreUnavailable, StoreTooSlow):
            if time.perf_counter() > asked.due:
                self.metrics.late()
            raise

    async def _gathered(self, asked: Asked, until: float, hung_up: HungUp) -> dict[str, Received]:
        """Messages of teammates; what can be worked out before the last of them is, while they are waited for."""
        live = asked.caller.live
        asked.begun = begun = self.deciding.engine.begin(live.session, asked.ego.message)
        try:
            async with _as_long_as_wanted(until, hung_up):
                return await live.gathering.collect(asked.frame, until, begun.add)
        except BaseException:
            begun.end()
            raise

    async def _check_ego_on_record(self, asked: Asked) -> None:
        """As `_check_ego`; a refusal goes on record."""
        await self.deciding.settled(asked)
        try:
            await self._check_ego(asked)
        except Unusable as error:
            await self.refuse(asked.caller, error, asked.frame)
            raise

    async def _check_ego(self, asked: Asked) -> None:
        """Refuse an ego's message that is not for a new frame, or from where the ego cannot be."""
        caller, frame, ego = asked.caller, asked.frame, asked.ego
        record = await self.sessions.current(caller)
        self.sessions.store.check_room(record)  # before anything is computed that could not be kept
        if record.last_frame is not None and frame <= record.last_frame:
            reason = Reason.REPLAYED if frame == record.last_frame else Reason.STALE
            before = caller.live.ego_proof if reason is Reason.REPLAYED else None
            if before is not None and before.digest != ego.digest:
                await self.sessions.journal.equivocation(caller, frame, before, ego)
            detail = f"frames must increase; the latest answered is {record.last_frame}"
            raise Unusable(Kind.STALE_FRAME, reason, detail)
        self._check_jump(frame, record.last_frame)
        doubt = caller.live.motion.implausible(caller.vehicle_id, frame, ego.message.pose)
        if doubt is not None:
            raise Unusable(Kind.IMPLAUSIBLE_POSE, Reason.MALFORMED, doubt, "ego.pose" if asked.whole else "pose")

    def _check_jump(self, frame: int, latest: int | None) -> None:
        """Refuse a frame so far after the latest that no later one would be left, or that a vehicle may be anywhere."""
        if latest is not None and frame - latest > self.max_jump:
            detail = f"frame {frame} is more than {self.max_jump} (ROBOSAC_MAX_FRAME_JUMP) after the latest, {latest}"
            raise Unusable(Kind.TOO_FAR_AHEAD, Reason.MALFORMED, detail)

    async def _keep(self, caller: Caller, frame: int, received: Received) -> SessionRecord:
        record = await self.sessions.current(caller)
        if caller.vehicle_id in record.token_ids:  # else it has left, which goes on record below
            caller.check_token(record)
        self.sessions.moving.check_open()
        try:
            closed = caller.live.gathering.closed
            self._check_jump(frame, None if closed < 0 else closed)
            caller.live.gathering.offer(frame, caller.vehicle_id, received)
        except Contradiction as lie:
            await self.sessions.journal.equivocation(caller, frame, lie.first, received)
            raise
        except Unusable as refused:
            await self.sessions.journal.refusal(caller, refused.reason, refused.detail, frame, "frame")
            raise
        self.sessions.moving.message_waits(caller)
        return record


def _expanded_by(asked: Asked, body: bytes) -> int:
    """By how many bytes the tensors of a body exceed it: they may have come compressed, or in a narrower type."""
    received = (asked.ego, *asked.messages.values())
    return max(sum(one.nbytes for one in received) - len(body), 0)


@contextlib.asynccontextmanager
async def _as_long_as_wanted(until: float, hung_up: HungUp) -> AsyncIterator[None]:
    """Wait in a block until then (`time.perf_counter`), if that is long only as long as whoever asked is there."""
    if until - time.perf_counter() < LONG_S:
        yield
        return

    async def watch(wait: asyncio.Timeout) -> None:
        await hung_up()
        wait.reschedule(-math.inf)

    try:
        async with asyncio.timeout(None) as wait:
            watching = asyncio.create_task(watch(wait))
            try:
                yield
            finally:
                watching.cancel()
    except TimeoutError:
        raise Refused(Kind.HUNG_UP, "the ego hung up before its teammates' messages were there") from None


@contextlib.asynccontextmanager
async def _its_turn(asked: Asked) -> AsyncIterator[None]:
    """Hold the session's lock for a block, if it comes before it is of no use any more."""
    lock = asked.caller.live.lock
    try:
        async with asyncio.timeout(max(asked.due - time.perf_counter(), 0.0) + GRACE_S):
            await lock.acquire()
    except TimeoutError:
        raise Refused(Kind.OVERLOADED, "the frame before this one took too long") from None
    try:
        yield
    finally:
        lock.release()
