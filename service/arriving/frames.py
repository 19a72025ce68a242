"""Frames that arrive: from bodies to messages that are checked, and to whoever answers them."""

from __future__ import annotations

import time
from typing import Any

import structlog

from robosac import wire
from robosac.answers import FrameAnswer, Reason
from robosac.audit.events import Proof
from robosac.defenses import Rejection
from robosac.detectors import Role
from robosac.signatures import is_valid, read_public_key
from service.deciding.admission import Admission
from service.deciding.answering import Asked, Deciding
from service.problems import Problem
from service.schemas import Receipt
from service.sessions.gathering import Equivocation, Received, Refused
from service.sessions.live import Caller
from service.sessions.sessions import Sessions
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)

STRANGERS_NAMED = 8
SLACK_BYTES = 64 * 1024
"""What a message may have besides its tensors."""
_REFUSALS = {
    Reason.LATE: (409, "stale-frame"),
    Reason.STALE: (409, "stale-frame"),
    Reason.REPLAYED: (409, "duplicate-message"),
    Reason.MALFORMED: (409, "too-far-ahead"),
    Reason.UNAUTHENTICATED: (403, "not-enrolled"),
}


class _Forged(Exception):
    """A message of a vehicle that signs, without its signature."""

    def __init__(self, field: str, detail: str) -> None:
        super().__init__(detail)
        self.field = field
        self.detail = detail


class Frames:
    """Takes messages and whole frames in, and has them answered.

    Parameters
    ----------
    sessions : Sessions
    deciding : Deciding
    metrics : Metrics
    admission : Admission
    """

    def __init__(self, sessions: Sessions, deciding: Deciding, metrics: Metrics, admission: Admission) -> None:
        self._sessions = sessions
        self._deciding = deciding
        self._metrics = metrics
        self._admission = admission

    async def post_message(self, caller: Caller, body: bytes) -> FrameAnswer | Receipt:
        """A vehicle's own message: kept for a teammate, answered for the ego."""
        arrived = time.perf_counter()
        frame = None
        try:
            envelope = wire.read_message(body)
            frame = envelope.frame
            if envelope.vehicle_id != caller.vehicle_id:
                detail = f"the token of {caller.vehicle_id} cannot speak for another vehicle"
                await self._refuse(caller, Reason.UNAUTHENTICATED, detail, frame, "vehicle_id")
                raise Problem(403, "wrong-vehicle", detail, "vehicle_id")
            received = _check(caller, caller.vehicle_id, frame, envelope.payload, "")
        except (wire.WireError, _Forged) as error:
            raise await self._unusable(caller, error, frame) from error
        if not caller.is_ego:
            await self._keep(caller, frame, received)
            return Receipt(frame=frame, vehicle_id=caller.vehicle_id)
        asked = Asked(caller, frame, received, arrived)
        asked.spent("receive", arrived)
        with self._admission.frame(caller.record.session_id, caller.live.budget_s):
            async with caller.live.lock:
                await self._check_ego(caller, frame, received)
                gathering = time.perf_counter()
                asked.messages = await caller.live.gathering.collect(frame, arrived + caller.record.gather_ms / 1e3)
                asked.spent("gather", gathering)
                return await self._deciding.answer(asked)

    async def post_frame(self, caller: Caller, body: bytes) -> FrameAnswer:
        """A whole frame from the ego; a teammate whose part is malformed is left out, and the frame is answered."""
        arrived = time.perf_counter()
        frame = None
        try:
            envelope = wire.read_frame(body)
            frame = envelope.frame
            ego = _check(caller, caller.vehicle_id, frame, envelope.ego, "ego")
        except (wire.WireError, _Forged) as error:
            raise await self._unusable(caller, error, frame) from error
        asked = Asked(caller, frame, ego, arrived)
        for name in caller.record.teammates:
            if name not in envelope.teammates:
                continue
            try:
                asked.messages[name] = _check(caller, name, frame, envelope.teammates[name], f"teammates.{name}")
            except (wire.WireError, _Forged) as error:
                reason = Reason.UNAUTHENTICATED if isinstance(error, _Forged) else Reason.MALFORMED
                asked.unusable[name] = Rejection(reason, {"field": error.field, "detail": error.detail})
                self._metrics.refused(reason.value)
        strangers = [name for name in envelope.teammates if name not in caller.record.teammates]
        for name in strangers[:STRANGERS_NAMED]:
            asked.unusable[str(name)[:64]] = Rejection(
                Reason.UNAUTHENTICATED, {"detail": "not enrolled in this session"}
            )
        asked.spent("receive", arrived)
        with self._admission.frame(caller.record.session_id, caller.live.budget_s):
            async with caller.live.lock:
                await self._check_ego(caller, frame, ego)
                return await self._deciding.answer(asked)

    def body_limit(self, caller: Caller, *, whole_frame: bool) -> int:
        """Bytes that a message, or a whole frame, of a session's detector may have."""
        tensors = caller.live.detector.info.tensors
        sizes = {role: sum(spec.nbytes for spec in specs.values()) + SLACK_BYTES for role, specs in tensors.items()}
        return sizes["ego"] + len(caller.record.teammates) * sizes["teammate"] if whole_frame else sizes[caller.role]

    async def note_unread(self, caller: Caller, problem: Problem) -> None:
        """Record that a body was refused before it was read."""
        await self._refuse(caller, Reason.MALFORMED, problem.detail, None, problem.field or "")

    async def kept_messages(self, caller: Caller, frame: int) -> bytes:
        """The messages kept of a decided frame, as a whole frame (`robosac.wire.read_frame`)."""
        kept = await self._sessions.messages(caller, frame)
        if kept is None:
            raise Problem(404, "messages-not-kept", "no messages of that frame are kept", "frame")
        return kept

    async def _check_ego(self, caller: Caller, frame: int, ego: Received) -> None:
        """Refuse an ego's message that is not for a new frame, or from where the ego cannot be."""
        record = await self._sessions.current(caller)
        if record.last_frame is not None and frame <= record.last_frame:
            reason = Reason.REPLAYED if frame == record.last_frame else Reason.STALE
            before = caller.live.ego_digest if reason is Reason.REPLAYED else None
            if before not in (None, ego.digest):
                await self._sessions.journal.equivocation(caller, frame, Proof(digest=str(before)), ego)
            detail = f"frames must increase; the latest answered is {record.last_frame}"
            await self._refuse(caller, reason, detail, frame, "frame")
            raise Problem(409, "stale-frame", detail, "frame")
        doubt = caller.live.motion.implausible(caller.vehicle_id, frame, ego.message.pose)
        if doubt is not None:
            field = "ego.pose"
            await self._refuse(caller, Reason.MALFORMED, doubt, frame, field)
            raise Problem(422, "implausible-pose", doubt, field)

    async def _keep(self, caller: Caller, frame: int, received: Received) -> None:
        await self._sessions.current(caller)
        if self._sessions.backlog.full:
            raise Problem(
                503, "overloaded", "too many messages are waiting for their egos", headers={"Retry-After": "1"}
            )
        try:
            caller.live.gathering.offer(frame, caller.vehicle_id, received)
        except Equivocation as lie:
            await self._sessions.journal.equivocation(caller, frame, lie.first, received)
            raise Problem(409, "equivocation", str(lie), "frame") from lie
        except Refused as refused:
            await self._sessions.journal.refusal(caller, refused.reason, refused.detail, frame, "frame")
            status, slug = _REFUSALS[refused.reason]
            raise Problem(status, slug, refused.detail, "frame") from refused

    async def _unusable(self, caller: Caller, error: wire.WireError | _Forged, frame: int | None) -> Problem:
        """Record a message that cannot be used; the problem to answer with."""
        if isinstance(error, _Forged):
            await self._refuse(caller, Reason.UNAUTHENTICATED, error.detail, frame, error.field)
            return Problem(401, "bad-signature", error.detail, error.field)
        await self._refuse(caller, Reason.MALFORMED, error.detail, frame, error.field)
        return Problem.from_wire(error)

    async def _refuse(self, caller: Caller, reason: Reason, detail: str, frame: int | None, field: str) -> None:
        if not caller.is_ego:
            caller.live.gathering.refuse(caller.vehicle_id, frame, reason, detail)
        await self._sessions.journal.refusal(caller, reason, detail, frame, field)


def _check(caller: Caller, vehicle: str, frame: int, payload: Any, path: str) -> Received:
    """A message that is well-formed and, where its sender signs, signed.

    Raises
    ------
    WireError
    _Forged
    """
    role: Role = "ego" if vehicle == caller.record.ego_id else "teammate"
    message = wire.check_message(payload, caller.live.detector.info, role, path)
    signature = wire.read_signature(payload, path)
    received = Received(message, wire.content_digest(frame, vehicle, message), signature)
    key = caller.record.public_keys.get(vehicle)
    if key is not None:
        field = f"{path}.signature" if path else "signature"
        if signature is None:
            raise _Forged(field, f"messages of {vehicle} must be signed")
        if not is_valid(read_public_key(key), caller.record.session_id, received.digest, signature):
            raise _Forged(field, f"not the signature of {vehicle} over this message for this session")
    return received
