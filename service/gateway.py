"""What the gateway does, apart from HTTP: sessions, identity, gathering, fusion, audit."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from robosac import wire
from robosac.budget import DomainError
from robosac.defenses import Defense, Reason, Rejection
from robosac.detectors import Detector, Message, Role
from robosac.fusion import FusionResult
from service import audit
from service.engine import Engine
from service.gathering import Gathering, Refused
from service.metrics import Metrics
from service.problems import Problem
from service.schemas import DefenseSettings, DetectorEntry, SessionCreated, SessionRequest, SessionState
from service.settings import Settings
from service.store import AuditRecord, SessionRecord, Store

logger = logging.getLogger(__name__)

SWEEP_EVERY_S = 30.0


@dataclass
class LiveSession:
    """What a session holds in this process only."""

    detector: Detector
    defense: Defense
    gathering: Gathering
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    last_used: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Caller:
    """Who speaks: the vehicle that a token belongs to, in the session it belongs to."""

    record: SessionRecord
    live: LiveSession
    vehicle_id: str

    @property
    def is_ego(self) -> bool:
        """Whether the ego speaks."""
        return self.vehicle_id == self.record.ego_id

    @property
    def role(self) -> Role:
        """In which role the vehicle speaks."""
        return "ego" if self.is_ego else "teammate"


class Gateway:
    """All of the service's behaviour.

    Parameters
    ----------
    settings : Settings
    store : Store
    engine : Engine
    metrics : Metrics
    new_seed : callable
        Seed of a frame's draws; from the operating system by default, so that nobody can foresee them.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        engine: Engine,
        metrics: Metrics,
        new_seed: Callable[[], int] = lambda: secrets.randbits(128),
    ) -> None:
        self.settings = settings
        self.engine = engine
        self.metrics = metrics
        self._store = store
        self._new_seed = new_seed
        self._live: dict[str, LiveSession] = {}

    async def open_session(self, request: SessionRequest) -> SessionCreated:
        """Begin a session; the answer is the only place where its tokens are shown."""
        detector = self._detector(request.detector or self.settings.detector)
        if len(request.teammates) > self.settings.max_teammates:
            raise Problem(
                422, "too-many-teammates", f"at most {self.settings.max_teammates} teammates are allowed", "teammates"
            )
        defense = request.defense.build()
        try:
            defense.check_team(len(request.teammates))
        except DomainError as error:
            raise Problem(422, "impossible-defense", str(error), "defense") from error
        budget_ms = request.latency_budget_ms or self.settings.latency_budget_ms
        gather_ms = min(self.settings.gather_ms, budget_ms / 2) if request.gather_ms is None else request.gather_ms
        if gather_ms > budget_ms:
            raise Problem(
                422, "invalid-request", f"must not exceed the latency budget of {budget_ms:g} ms", "gather_ms"
            )
        if await self._store.count() >= self.settings.max_sessions:
            raise Problem(
                503, "too-many-sessions", "the gateway holds as many sessions as it may", headers={"Retry-After": "30"}
            )
        tokens = {vehicle: secrets.token_urlsafe(32) for vehicle in (request.ego_id, *request.teammates)}
        record = SessionRecord(
            session_id=secrets.token_hex(16),
            ego_id=request.ego_id,
            teammates=tuple(request.teammates),
            detector=detector.info.name,
            defense=request.defense.model_dump(),
            latency_budget_ms=budget_ms,
            gather_ms=gather_ms,
            token_digests={_digest(token): vehicle for vehicle, token in tokens.items()},
            created_at=audit.now(),
            state=defense.initial_state(),
        )
        await self._store.create(record, audit.session_opened(record, detector.info))
        self._live[record.session_id] = self._revive(record)
        self.metrics.sessions.set(await self._store.count())
        return SessionCreated(
            session_id=record.session_id,
            ego_token=tokens.pop(request.ego_id),
            teammate_tokens=tokens,
            detector=DetectorEntry.of(detector.info),
            defense=request.defense,
            latency_budget_ms=record.latency_budget_ms,
            gather_ms=record.gather_ms,
        )

    async def authenticate(self, session_id: str, token: str | None) -> Caller:
        """The vehicle that a token belongs to.

        Raises
        ------
        Problem
            404 for an unknown session, 401 without a token of it.
        """
        record = await self._store.get(session_id)
        if record is None:
            raise Problem(404, "unknown-session", "there is no such session; it may have ended or expired")
        vehicle = record.token_digests.get(_digest(token)) if token else None
        if vehicle is None:
            raise Problem(
                401,
                "unauthenticated",
                "a bearer token of a vehicle of this session is needed",
                headers={"WWW-Authenticate": "Bearer"},
            )
        live = self._live.get(session_id)
        if live is None:
            live = self._live[session_id] = self._revive(record)
        live.last_used = time.monotonic()
        return Caller(record, live, vehicle)

    async def authenticate_ego(self, session_id: str, token: str | None) -> Caller:
        """As `authenticate`, but 403 for anybody but the ego."""
        caller = await self.authenticate(session_id, token)
        if not caller.is_ego:
            raise Problem(403, "ego-only", f"only the ego of the session may do this, not {caller.vehicle_id}")
        return caller

    async def post_message(self, caller: Caller, body: bytes) -> tuple[int, dict[str, Any]]:
        """A vehicle's own message: kept for a teammate (202 and a receipt), answered for the ego (200 and the
        result).
        """
        received = time.perf_counter()
        try:
            envelope = wire.read_message(body)
        except wire.WireError as error:
            raise await self._malformed(caller, error, None) from error
        if envelope.vehicle_id != caller.vehicle_id:
            detail = f"the token of {caller.vehicle_id} cannot speak for another vehicle"
            await self._refuse(caller, Reason.UNAUTHENTICATED, detail, envelope.frame, "vehicle_id")
            raise Problem(403, "wrong-vehicle", detail, "vehicle_id")
        try:
            message = wire.check_message(envelope.payload, caller.live.detector.info, caller.role)
        except wire.WireError as error:
            raise await self._malformed(caller, error, envelope.frame) from error
        if not caller.is_ego:
            await self._keep(caller, envelope.frame, message)
            return 202, {"frame": envelope.frame, "vehicle_id": caller.vehicle_id, "status": "accepted"}
        timings = {"receive": (time.perf_counter() - received) * 1e3}
        async with caller.live.lock:
            await self._check_order(caller, envelope.frame)
            gathering = time.perf_counter()
            until = received + caller.record.gather_ms / 1e3
            messages, absent = await caller.live.gathering.collect(envelope.frame, until)
            timings["gather"] = (time.perf_counter() - gathering) * 1e3
            return 200, await self._answer(caller, envelope.frame, message, messages, absent, received, timings)

    async def post_frame(self, caller: Caller, body: bytes) -> dict[str, Any]:
        """A whole frame from the ego; a teammate whose part is malformed is left out, and the frame is answered."""
        received = time.perf_counter()
        info = caller.live.detector.info
        try:
            envelope = wire.read_frame(body)
            ego = wire.check_message(envelope.ego, info, "ego", "ego")
        except wire.WireError as error:
            raise await self._malformed(caller, error, None) from error
        messages: dict[str, Message] = {}
        absent: dict[str, Rejection] = {}
        for name in caller.record.teammates:
            if name not in envelope.teammates:
                absent[name] = caller.live.gathering.absence(name)
                continue
            try:
                messages[name] = wire.check_message(envelope.teammates[name], info, "teammate", f"teammates.{name}")
            except wire.WireError as error:
                absent[name] = Rejection(Reason.MALFORMED, {"field": error.field, "detail": error.detail})
                self.metrics.refused(Reason.MALFORMED.value)
        strangers = [name for name in envelope.teammates if name not in caller.record.teammates]
        for name in strangers[:8]:
            absent[name] = Rejection(Reason.UNAUTHENTICATED, {"detail": "not enrolled in this session"})
        timings = {"receive": (time.perf_counter() - received) * 1e3}
        async with caller.live.lock:
            await self._check_order(caller, envelope.frame)
            return await self._answer(caller, envelope.frame, ego, messages, absent, received, timings)

    async def describe(self, caller: Caller) -> SessionState:
        """The session's state."""
        record = await self._current(caller)
        return SessionState(
            session_id=record.session_id,
            ego_id=record.ego_id,
            teammates=list(record.teammates),
            detector=record.detector,
            defense=DefenseSettings.model_validate(record.defense),
            latency_budget_ms=record.latency_budget_ms,
            gather_ms=record.gather_ms,
            created_at=record.created_at,
            last_frame=record.last_frame,
            frames_answered=record.frames_answered,
            state=dict(record.state),
            audit_seq=record.audit_seq,
        )

    async def audit_log(self, caller: Caller, after: int) -> list[AuditRecord]:
        """The session's audit records with a number above ``after``."""
        return await self._store.audit(caller.record.session_id, after)

    async def close_session(self, caller: Caller) -> None:
        """End a session, after the frame in hand."""
        async with caller.live.lock:
            await self._forget(caller.record.session_id)

    async def expire_idle_sessions(self) -> None:
        """End, every so often and for ever, the sessions that nobody has used for too long."""
        while True:
            await asyncio.sleep(SWEEP_EVERY_S)
            oldest = time.monotonic() - self.settings.session_idle_s
            for session_id in [
                s for s, live in self._live.items() if live.last_used < oldest and not live.lock.locked()
            ]:
                await self._forget(session_id)

    def detector_list(self) -> list[DetectorEntry]:
        """All detectors."""
        return [DetectorEntry.of(detector.info) for detector in self.engine.detectors.values()]

    def _detector(self, name: str) -> Detector:
        if not self.engine.ready:
            raise Problem(503, "not-ready", "the gateway is still warming up", headers={"Retry-After": "5"})
        if name not in self.engine.detectors:
            known = ", ".join(self.engine.detectors)
            raise Problem(422, "unknown-detector", f"there is no detector of that name; known: {known}", "detector")
        return self.engine.detectors[name]

    def _revive(self, record: SessionRecord) -> LiveSession:
        defense = DefenseSettings.model_validate(record.defense).build()
        closed = -1 if record.last_frame is None else record.last_frame
        gathering = Gathering(record.teammates, self.settings.max_pending_frames, closed)
        return LiveSession(self._detector(record.detector), defense, gathering)

    async def _forget(self, session_id: str) -> None:
        self._live.pop(session_id, None)
        await self._store.delete(session_id)
        self.metrics.sessions.set(await self._store.count())

    async def _current(self, caller: Caller) -> SessionRecord:
        """The session as it is now; it may have moved on, or ended, since the caller was authenticated."""
        record = await self._store.get(caller.record.session_id)
        if record is None:
            raise Problem(404, "unknown-session", "the session has ended")
        return record

    async def _check_order(self, caller: Caller, frame: int) -> None:
        record = await self._current(caller)
        if record.last_frame is not None and frame <= record.last_frame:
            reason = Reason.REPLAYED if frame == record.last_frame else Reason.STALE
            detail = f"frames must increase; the latest answered is {record.last_frame}"
            await self._refuse(caller, reason, detail, frame, "frame")
            raise Problem(409, "stale-frame", detail, "frame")

    async def _keep(self, caller: Caller, frame: int, message: Message) -> None:
        try:
            caller.live.gathering.offer(frame, caller.vehicle_id, message)
        except Refused as refused:
            await self._log_refusal(caller, refused.reason, refused.detail, frame, "frame")
            slug = "duplicate-message" if refused.reason is Reason.REPLAYED else "stale-frame"
            raise Problem(409, slug, refused.detail, "frame") from refused

    async def _malformed(self, caller: Caller, error: wire.WireError, frame: int | None) -> Problem:
        await self._refuse(caller, Reason.MALFORMED, error.detail, frame, error.field)
        return Problem.from_wire(error)

    async def _refuse(self, caller: Caller, reason: Reason, detail: str, frame: int | None, field: str) -> None:
        if not caller.is_ego:
            caller.live.gathering.refuse(caller.vehicle_id, reason, detail)
        await self._log_refusal(caller, reason, detail, frame, field)

    async def _log_refusal(self, caller: Caller, reason: Reason, detail: str, frame: int | None, field: str) -> None:
        self.metrics.refused(reason.value)
        event = audit.message_refused(caller.vehicle_id, reason, detail, frame=frame, field=field)
        await self._store.log(caller.record.session_id, event)

    async def _answer(
        self,
        caller: Caller,
        frame: int,
        ego: Message,
        messages: Mapping[str, Message],
        absent: Mapping[str, Rejection],
        received: float,
        timings: dict[str, float],
    ) -> dict[str, Any]:
        """Fuse, keep the decision, and build the frame result. The session's lock is held."""
        record = await self._current(caller)
        caller.live.gathering.close(frame)
        seed = self._new_seed()
        result, timings["queue"] = await self.engine.fuse(
            caller.live.detector,
            caller.live.defense,
            ego,
            messages,
            seed=seed,
            state=record.state,
            deadline=received + record.latency_budget_ms / 1e3,
        )
        timings.update(result.timings_ms)
        timings["total"] = (time.perf_counter() - received) * 1e3
        answer = _frame_result(frame, result, {**absent, **result.rejected}, timings)
        await self._store.decide(record.session_id, frame, result.state, audit.frame_answered(answer, result, seed))
        reasons = [entry["reason"] for entry in answer["rejected"]]
        self.metrics.frame(result, reasons, answer["degraded_by"], timings)
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


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
