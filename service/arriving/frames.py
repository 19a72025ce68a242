"""Frames that arrive: from bodies to messages that are checked, and to whoever answers them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from robosac import wire
from robosac.answers import FrameAnswer, Reason
from robosac.audit.events import Proof
from robosac.defenses import Rejection
from robosac.detectors import Role
from robosac.signatures import is_valid, read_public_key
from service.deciding.admission import Admission
from service.deciding.answering import Asked, Deciding
from service.errors import Kind, Refused, Unusable
from service.schemas import Receipt
from service.sessions.gathering import Contradiction, Received
from service.sessions.live import Caller
from service.sessions.sessions import Sessions
from service.watching.metrics import Metrics

STRANGERS_NAMED = 8
SLACK_BYTES = 64 * 1024
"""What a message may have besides its tensors."""


@dataclass(frozen=True)
class Frames:
    """Takes messages and whole frames in, and has them answered."""

    sessions: Sessions
    deciding: Deciding
    metrics: Metrics
    admission: Admission

    async def post_message(self, caller: Caller, body: bytes) -> FrameAnswer | Receipt:
        """A vehicle's own message: kept for a teammate, answered for the ego."""
        arrived = time.perf_counter()
        frame = None
        try:
            envelope = wire.read_message(body)
            frame = envelope.frame
            if envelope.vehicle_id != caller.vehicle_id:
                detail = f"the token of {caller.vehicle_id} cannot speak for another vehicle"
                raise Unusable(Kind.WRONG_VEHICLE, Reason.UNAUTHENTICATED, detail, "vehicle_id")
            received = _check(caller, caller.vehicle_id, frame, envelope.payload, "")
        except (wire.WireError, Unusable) as error:
            await self.refuse(caller, error, frame)
            raise
        if not caller.is_ego:
            await self._keep(caller, frame, received)
            return Receipt(frame=frame, vehicle_id=caller.vehicle_id)
        asked = Asked(caller, frame, received, arrived)
        asked.spent("receive", arrived)
        return await self._answer(asked, gather=True)

    async def post_frame(self, caller: Caller, body: bytes) -> FrameAnswer:
        """A whole frame from the ego; a teammate whose part is malformed is left out, and the frame is answered."""
        arrived = time.perf_counter()
        frame = None
        try:
            envelope = wire.read_frame(body)
            frame = envelope.frame
            ego = _check(caller, caller.vehicle_id, frame, envelope.ego, "ego")
        except (wire.WireError, Unusable) as error:
            await self.refuse(caller, error, frame)
            raise
        asked = Asked(caller, frame, ego, arrived)
        for name in caller.record.teammates:
            if name not in envelope.teammates:
                continue
            try:
                asked.messages[name] = _check(caller, name, frame, envelope.teammates[name], f"teammates.{name}")
            except (wire.WireError, Unusable) as error:
                reason = _reason(error)
                asked.unusable[name] = Rejection(reason, {"field": error.field, "detail": error.detail})
                self.metrics.refused(reason.value)
        strangers = [name for name in envelope.teammates if name not in caller.record.teammates]
        for name in strangers[:STRANGERS_NAMED]:
            asked.unusable[str(name)[:64]] = Rejection(
                Reason.UNAUTHENTICATED, {"detail": "not enrolled in this session"}
            )
        asked.spent("receive", arrived)
        return await self._answer(asked, gather=False)

    def body_limit(self, caller: Caller, *, whole_frame: bool) -> int:
        """Bytes that a message, or a whole frame, of a session's detector may have."""
        tensors = caller.live.detector.info.tensors
        sizes = {role: sum(spec.nbytes for spec in specs.values()) + SLACK_BYTES for role, specs in tensors.items()}
        return sizes["ego"] + len(caller.record.teammates) * sizes["teammate"] if whole_frame else sizes[caller.role]

    async def refuse(self, caller: Caller, error: wire.WireError | Refused, frame: int | None = None) -> None:
        """Record a message that does not count; ``frame`` is the one that it was for, if that is known."""
        reason = _reason(error)
        if not caller.is_ego:
            caller.live.gathering.refuse(caller.vehicle_id, frame, reason, error.detail)
        await self.sessions.journal.refusal(caller, reason, error.detail, frame, error.field or "")

    async def _answer(self, asked: Asked, *, gather: bool) -> FrameAnswer:
        caller, frame = asked.caller, asked.frame
        with self.admission.frame(caller.record.session_id, caller.live.budget_s):
            async with caller.live.lock:
                try:
                    await self._check_ego(caller, frame, asked.ego)
                except Unusable as error:
                    await self.refuse(caller, error, frame)
                    raise
                if gather:
                    began, until = time.perf_counter(), asked.arrived + caller.record.gather_ms / 1e3
                    asked.messages = await caller.live.gathering.collect(frame, until)
                    asked.spent("gather", began)
                return await self.deciding.answer(asked)

    async def _check_ego(self, caller: Caller, frame: int, ego: Received) -> None:
        """Refuse an ego's message that is not for a new frame, or from where the ego cannot be."""
        record = await self.sessions.current(caller)
        if record.last_frame is not None and frame <= record.last_frame:
            reason = Reason.REPLAYED if frame == record.last_frame else Reason.STALE
            before = caller.live.ego_digest if reason is Reason.REPLAYED else None
            if before not in (None, ego.digest):
                await self.sessions.journal.equivocation(caller, frame, Proof(digest=str(before)), ego)
            detail = f"frames must increase; the latest answered is {record.last_frame}"
            raise Unusable(Kind.STALE_FRAME, reason, detail)
        doubt = caller.live.motion.implausible(caller.vehicle_id, frame, ego.message.pose)
        if doubt is not None:
            raise Unusable(Kind.IMPLAUSIBLE_POSE, Reason.MALFORMED, doubt, "ego.pose")

    async def _keep(self, caller: Caller, frame: int, received: Received) -> None:
        await self.sessions.current(caller)
        if self.sessions.backlog.full:
            raise Refused(Kind.OVERLOADED, "too many messages are waiting for their egos")
        try:
            caller.live.gathering.offer(frame, caller.vehicle_id, received)
        except Contradiction as lie:
            await self.sessions.journal.equivocation(caller, frame, lie.first, received)
            raise
        except Unusable as refused:
            await self.sessions.journal.refusal(caller, refused.reason, refused.detail, frame, "frame")
            raise


def _reason(error: wire.WireError | Refused) -> Reason:
    return error.reason if isinstance(error, Unusable) else Reason.MALFORMED


def _check(caller: Caller, vehicle: str, frame: int, payload: Any, path: str) -> Received:
    """A message that is well-formed and, where its sender signs, signed.

    Raises
    ------
    WireError, Unusable
    """
    role: Role = "ego" if vehicle == caller.record.ego_id else "teammate"
    message = wire.check_message(payload, caller.live.detector.info, role, path)
    signature = wire.read_signature(payload, path)
    received = Received(message, wire.content_digest(frame, vehicle, message), signature)
    key = caller.record.public_keys.get(vehicle)
    if key is not None:
        field = f"{path}.signature" if path else "signature"
        if signature is None:
            raise Unusable(Kind.BAD_SIGNATURE, Reason.UNAUTHENTICATED, f"messages of {vehicle} must be signed", field)
        if not is_valid(read_public_key(key), caller.record.session_id, received.digest, signature):
            detail = f"not the signature of {vehicle} over this message for this session"
            raise Unusable(Kind.BAD_SIGNATURE, Reason.UNAUTHENTICATED, detail, field)
    return received
