"""Frames: from bodies to an answer."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any

from robosac import wire
from robosac.defenses import Reason, Rejection
from robosac.detectors import Message
from robosac.fusion import FusionResult
from service import audit
from service.engine import Engine
from service.gathering import Refused
from service.metrics import Metrics
from service.problems import Problem
from service.sessions import Caller, Sessions

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


class Frames:
    """Takes messages and whole frames, and answers them.

    Parameters
    ----------
    sessions : Sessions
    engine : Engine
    metrics : Metrics
    new_seed : callable
        Seed of a frame's draws; from the operating system by default, so that nobody can foresee them.
    """

    def __init__(
        self,
        sessions: Sessions,
        engine: Engine,
        metrics: Metrics,
        new_seed: Callable[[], int] = lambda: secrets.randbits(128),
    ) -> None:
        self._sessions = sessions
        self._engine = engine
        self._metrics = metrics
        self._new_seed = new_seed

    async def post_message(self, caller: Caller, body: bytes) -> tuple[int, dict[str, Any]]:
        """A vehicle's own message: kept for a teammate (202 and a receipt), answered for the ego (200 and the
        result).
        """
        received = time.perf_counter()
        frame = None
        try:
            envelope = wire.read_message(body)
            frame = envelope.frame
            if envelope.vehicle_id != caller.vehicle_id:
                detail = f"the token of {caller.vehicle_id} cannot speak for another vehicle"
                await self._refuse(caller, Reason.UNAUTHENTICATED, detail, frame, "vehicle_id")
                raise Problem(403, "wrong-vehicle", detail, "vehicle_id")
            message = wire.check_message(envelope.payload, caller.live.detector.info, caller.role)
        except wire.WireError as error:
            raise await self._malformed(caller, error, frame) from error
        if not caller.is_ego:
            await self._keep(caller, frame, message)
            return 202, {"frame": frame, "vehicle_id": caller.vehicle_id, "status": "accepted"}
        timings = {"receive": (time.perf_counter() - received) * 1e3}
        async with caller.live.lock:
            await self._check_order(caller, frame)
            gathering = time.perf_counter()
            messages = await caller.live.gathering.collect(frame, received + caller.record.gather_ms / 1e3)
            timings["gather"] = (time.perf_counter() - gathering) * 1e3
            return 200, await self._answer(caller, frame, message, messages, {}, received, timings)

    async def post_frame(self, caller: Caller, body: bytes) -> dict[str, Any]:
        """A whole frame from the ego; a teammate whose part is malformed is left out, and the frame is answered."""
        received = time.perf_counter()
        info = caller.live.detector.info
        frame = None
        try:
            envelope = wire.read_frame(body)
            frame = envelope.frame
            ego = wire.check_message(envelope.ego, info, "ego", "ego")
        except wire.WireError as error:
            raise await self._malformed(caller, error, frame) from error
        messages: dict[str, Message] = {}
        unusable: dict[str, Rejection] = {}
        for name in caller.record.teammates:
            if name not in envelope.teammates:
                continue
            try:
                messages[name] = wire.check_message(envelope.teammates[name], info, "teammate", f"teammates.{name}")
            except wire.WireError as error:
                unusable[name] = Rejection(Reason.MALFORMED, {"field": error.field, "detail": error.detail})
                self._metrics.refused(Reason.MALFORMED.value)
        strangers = [name for name in envelope.teammates if name not in caller.record.teammates]
        for name in strangers[:STRANGERS_NAMED]:
            unusable[str(name)[:64]] = Rejection(Reason.UNAUTHENTICATED, {"detail": "not enrolled in this session"})
        timings = {"receive": (time.perf_counter() - received) * 1e3}
        async with caller.live.lock:
            await self._check_order(caller, frame)
            return await self._answer(caller, frame, ego, messages, unusable, received, timings)

    def body_limit(self, caller: Caller, *, whole_frame: bool) -> int:
        """Bytes that a message, or a whole frame, of a session's detector may have."""
        tensors = caller.live.detector.info.tensors
        sizes = {role: sum(spec.nbytes for spec in specs.values()) + SLACK_BYTES for role, specs in tensors.items()}
        return sizes["ego"] + len(caller.record.teammates) * sizes["teammate"] if whole_frame else sizes[caller.role]

    async def note_unread(self, caller: Caller, problem: Problem) -> None:
        """Record that a body was refused before it was read."""
        await self._refuse(caller, Reason.MALFORMED, problem.detail, None, problem.field or "")

    async def _check_order(self, caller: Caller, frame: int) -> None:
        record = await self._sessions.current(caller)
        if record.last_frame is not None and frame <= record.last_frame:
            reason = Reason.REPLAYED if frame == record.last_frame else Reason.STALE
            detail = f"frames must increase; the latest answered is {record.last_frame}"
            await self._refuse(caller, reason, detail, frame, "frame")
            raise Problem(409, "stale-frame", detail, "frame")

    async def _keep(self, caller: Caller, frame: int, message: Message) -> None:
        await self._sessions.current(caller)
        try:
            caller.live.gathering.offer(frame, caller.vehicle_id, message)
        except Refused as refused:
            await self._sessions.log_refusal(caller, refused.reason, refused.detail, frame, "frame")
            status, slug = _REFUSALS[refused.reason]
            raise Problem(status, slug, refused.detail, "frame") from refused

    async def _malformed(self, caller: Caller, error: wire.WireError, frame: int | None) -> Problem:
        await self._refuse(caller, Reason.MALFORMED, error.detail, frame, error.field)
        return Problem.from_wire(error)

    async def _refuse(self, caller: Caller, reason: Reason, detail: str, frame: int | None, field: str) -> None:
        if not caller.is_ego:
            caller.live.gathering.refuse(caller.vehicle_id, frame, reason, detail)
        await self._sessions.log_refusal(caller, reason, detail, frame, field)

    async def _answer(
        self,
        caller: Caller,
        frame: int,
        ego: Message,
        messages: Mapping[str, Message],
        unusable: Mapping[str, Rejection],
        received: float,
        timings: dict[str, float],
    ) -> dict[str, Any]:
        """Fuse, keep the decision, and build the frame result. The session's lock is held.

        The team is the one of this moment, whoever was in it when the messages came; ``unusable`` says why parts of the
        body are not among the messages.
        """
        record = await self._sessions.current(caller)
        gathering = caller.live.gathering
        present = {name: messages[name] for name in record.teammates if name in messages}
        unheard = {name: gathering.absence(name, frame) for name in record.teammates if name not in present}
        gathering.close(frame)
        seed = self._new_seed()
        result, timings["queue"] = await self._engine.fuse(
            caller.live.detector,
            caller.live.defense,
            ego,
            present,
            seed=seed,
            state=record.state,
            frame=frame,
            previous=caller.live.previous,
            deadline=received + record.latency_budget_ms / 1e3,
        )
        timings.update(result.timings_ms)
        timings["total"] = (time.perf_counter() - received) * 1e3
        answer = _frame_result(frame, result, {**unheard, **unusable, **result.rejected}, timings)
        caller.live.previous = result.previous
        await self._sessions.decide(
            caller, frame, result.state, audit.frame_answered(answer, result, seed, caller.live.unlogged())
        )
        reasons = [entry["reason"] for entry in answer["rejected"]]
        self._metrics.frame(result, reasons, answer["degraded_by"], timings)
        return answer


def _frame_result(
    frame: int, result: FusionResult, rejected: Mapping[str, Rejection], timings: Mapping[str, float]
) -> dict[str, Any]:
    degraded_by = "fault" if result.fault is not None else "deadline" if result.out_of_time else None
    return {
        "frame": frame,
        "boxes": [[float(value) for value in box] for box in result.boxes],
        "source": result.source.value,
        "accepted": list(result.accepted),
        "rejected": [{"vehicle_id": name, "reason": r.reason.value, **r.evidence} for name, r in rejected.items()],
        "hypotheses": [
            {"teammates": list(o.teammates), "jaccard_index": o.jaccard_index, "verdict": o.verdict.value}
            for o in result.hypotheses
        ],
        "sampling_steps": result.sampling_steps,
        "attacker_ratio": result.attacker_ratio,
        "deadline_met": result.deadline_met,
        "degraded_by": degraded_by,
        "timings_ms": {stage: round(milliseconds, 3) for stage, milliseconds in timings.items()},
    }
