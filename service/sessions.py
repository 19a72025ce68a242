"""Sessions: opening and ending them, who speaks in them, who belongs to them."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import structlog

from robosac.audit import commitment
from robosac.budget import DomainError
from robosac.defenses import Reason
from robosac.detectors import Detector
from service import audit
from service.engine import Engine
from service.gathering import Backlog, Gathering
from service.identity import TokenRefused, Tokens, unauthenticated
from service.journal import Journal
from service.live import Caller, LiveSession
from service.metrics import Metrics
from service.motion import Motion
from service.problems import Problem
from service.schemas import (
    DetectorEntry,
    SessionCreated,
    SessionRequest,
    SessionState,
    TeamChanged,
    TokenRenewed,
    read_defense,
)
from service.settings import Settings
from service.store import (
    AuditEvent,
    FrameDecided,
    SessionChanged,
    SessionOver,
    SessionRecord,
    Store,
    StoreUnavailable,
    new_seed,
)

logger = structlog.stdlib.get_logger(__name__)

SWEEP_EVERY_S = 30.0
MAX_RENEWALS = 16
"""Tokens that a vehicle may take between two frames: each leaves a record."""


class Sessions:
    """All sessions of this gateway.

    Parameters
    ----------
    settings : Settings
    store : Store
    engine : Engine
    metrics : Metrics
    tokens : Tokens
    seeds : callable
        Seed of a frame's draws, hexadecimal; from the operating system by default, so that nobody can foresee them.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        engine: Engine,
        metrics: Metrics,
        tokens: Tokens,
        seeds: Callable[[], str] = new_seed,
    ) -> None:
        self._seeds = seeds
        self._settings = settings
        self._store = store
        self._engine = engine
        self._metrics = metrics
        self._tokens = tokens
        self._live: dict[str, LiveSession] = {}
        self.backlog = Backlog(settings.max_pending_bytes)
        self.journal = Journal(store, metrics)

    async def open(self, request: SessionRequest) -> SessionCreated:
        """Begin a session; the answer is the only place where its tokens are shown."""
        detector = self._detector(self._settings.detector if request.detector is None else request.detector)
        self._check_size(request.teammates)
        try:
            defense = request.defense.build(detector.info)
            defense.check_team(len(request.teammates))
        except DomainError as error:
            raise Problem(422, "impossible-defense", str(error), "defense") from error
        budget_ms = request.latency_budget_ms or self._settings.latency_budget_ms
        gather_ms = min(self._settings.gather_ms, budget_ms / 2) if request.gather_ms is None else request.gather_ms
        if gather_ms > budget_ms:
            raise Problem(
                422, "invalid-request", f"must not exceed the latency budget of {budget_ms:g} ms", "gather_ms"
            )
        already_open = await self._store.count()
        if already_open >= self._settings.max_sessions:
            raise Problem(
                503, "too-many-sessions", "the gateway holds as many sessions as it may", headers={"Retry-After": "30"}
            )
        session_id = secrets.token_hex(16)
        own = self._tokens.issue(session_id, request.ego_id, is_ego=True)
        others = {name: self._tokens.issue(session_id, name, is_ego=False) for name in request.teammates}
        record = SessionRecord(
            session_id=session_id,
            ego_id=request.ego_id,
            teammates=tuple(request.teammates),
            detector=detector.info.name,
            defense=request.defense.model_dump(mode="json"),
            latency_budget_ms=budget_ms,
            gather_ms=gather_ms,
            frame_period_ms=request.frame_period_ms,
            token_ids={name: token.token_id for name, token in {request.ego_id: own, **others}.items()},
            public_keys=dict(request.public_keys),
            created_at=audit.now(),
            seed=self._seeds(),
            state=defense.initial_state(request.teammates),
        )
        await self._store.create(record, audit.session_opened(record, detector.info))
        self._live[record.session_id] = self._revive(record)
        self._metrics.sessions.set(already_open + 1)
        logger.info(
            "session opened",
            session_id=record.session_id,
            ego_id=record.ego_id,
            teammates=len(record.teammates),
            detector=record.detector,
            defense=request.defense.kind,
        )
        return SessionCreated(
            session_id=record.session_id,
            ego_token=own.text,
            teammate_tokens={name: token.text for name, token in others.items()},
            tokens_expire_at=own.expires_at,
            detector=DetectorEntry.of(detector.info),
            defense=request.defense,
            latency_budget_ms=record.latency_budget_ms,
            gather_ms=record.gather_ms,
            frame_period_ms=record.frame_period_ms,
        )

    async def authenticate(self, session_id: str, token: str | None) -> Caller:
        """The vehicle that a token belongs to.

        Raises
        ------
        Problem
            404 for an unknown or ended session, 401 without a token of it, 503 if its detector is not served any more.
        """
        record = await self._store.get(session_id)
        if record is None or record.ended_at is not None:
            self._forget(session_id)
            raise Problem(404, "unknown-session", "there is no such session; it may have ended or expired")
        vehicle = await self._holder(record, token)
        live = self._live_session(record)
        live.follow(record)
        live.last_used = time.monotonic()
        return Caller(record, live, vehicle)

    async def authenticate_ego(self, session_id: str, token: str | None) -> Caller:
        """As `authenticate`, but 403 for anybody but the ego."""
        caller = await self.authenticate(session_id, token)
        if not caller.is_ego:
            problem = _ego_only(caller.vehicle_id)
            await self.journal.refusal(caller, Reason.UNAUTHENTICATED, problem.detail, None, "")
            raise problem
        return caller

    def budget_s(self, session_id: str) -> float | None:
        """Latency budget of a session that is in use."""
        live = self._live.get(session_id)
        return None if live is None else live.budget_s

    async def audit_log(self, session_id: str, token: str | None, after: int) -> list[str]:
        """Lines of the log with a number above ``after``, for the ego; of a session no longer served, too."""
        record = await self._store.get(session_id)
        if record is None:
            raise Problem(404, "unknown-session", "there is no such session; its log may have been purged")
        if record.ended_at is None and self._is_served(record):
            await self.authenticate_ego(session_id, token)
        elif (vehicle := await self._holder(record, token)) != record.ego_id:
            raise _ego_only(vehicle)
        return await self._store.audit(session_id, after)

    async def enrol(self, caller: Caller, newcomers: Sequence[str], public_keys: Mapping[str, str]) -> TeamChanged:
        """Let teammates join, from the next frame on; the answer is the only place where their tokens are shown."""
        async with caller.live.lock:
            record = await self.current(caller)
            for name in newcomers:
                if name == record.ego_id or name in record.teammates:
                    raise Problem(409, "already-enrolled", f"{name} is in the session already", "teammates")
            tokens = {name: self._tokens.issue(record.session_id, name, is_ego=False) for name in newcomers}
            token_ids = {**record.token_ids, **{name: token.token_id for name, token in tokens.items()}}
            keys = {**record.public_keys, **public_keys}
            await self._change_team(caller, record, (*record.teammates, *newcomers), token_ids, keys)
            return TeamChanged(
                teammates=[*record.teammates, *newcomers],
                teammate_tokens={name: token.text for name, token in tokens.items()},
                tokens_expire_at=min(token.expires_at for token in tokens.values()),
            )

    async def dismiss(self, caller: Caller, leaver: str) -> None:
        """Let a teammate leave, from the next frame on; its token is worth nothing any more."""
        async with caller.live.lock:
            record = await self.current(caller)
            if leaver not in record.teammates:
                raise Problem(404, "unknown-teammate", "there is no such teammate in the session")
            token_ids = {name: token_id for name, token_id in record.token_ids.items() if name != leaver}
            keys = {name: key for name, key in record.public_keys.items() if name != leaver}
            team = tuple(name for name in record.teammates if name != leaver)
            await self._change_team(caller, record, team, token_ids, keys)

    async def renew(self, caller: Caller) -> TokenRenewed:
        """A fresh token of the caller; the one it came with is worth nothing any more."""
        vehicle = caller.vehicle_id
        async with caller.live.lock:  # else a team that changes meanwhile would bring the old token back
            record = await self.current(caller)
            if record.token_ids.get(vehicle) != caller.record.token_ids[vehicle]:
                raise unauthenticated("the token was renewed, or its vehicle has left")
            if caller.live.renewals[vehicle] >= MAX_RENEWALS:
                detail = f"a vehicle may have {MAX_RENEWALS} tokens between two frames"
                raise Problem(429, "too-many-renewals", detail, headers={"Retry-After": "1"})
            caller.live.renewals[vehicle] += 1
            token = self._tokens.issue(record.session_id, vehicle, is_ego=caller.is_ego)
            event = audit.token_renewed(vehicle, token.expires_at)
            try:
                await self._store.renew_token(record.session_id, vehicle, token.token_id, event)
            except SessionOver as error:
                raise _over() from error
            return TokenRenewed(token=token.text, expires_at=token.expires_at)

    async def describe(self, caller: Caller) -> SessionState:
        """The session's state."""
        record = await self.current(caller)
        return SessionState(
            session_id=record.session_id,
            ego_id=record.ego_id,
            teammates=list(record.teammates),
            detector=record.detector,
            defense=read_defense(record.defense),
            latency_budget_ms=record.latency_budget_ms,
            gather_ms=record.gather_ms,
            frame_period_ms=record.frame_period_ms,
            created_at=record.created_at,
            last_frame=record.last_frame,
            frames_answered=record.frames_answered,
            state=dict(record.state),
            suspicion=record.state.get("suspicion"),
            audit_seq=record.audit_seq,
            audit_head=record.audit_head,
            next_seed_commitment=commitment(record.seed),
        )

    async def close(self, caller: Caller) -> str:
        """End a session, after the frame in hand; the head of its log, which is complete by then."""
        async with caller.live.lock:
            await self._end(caller.record.session_id, "closed")
        record = await self._store.get(caller.record.session_id)
        if record is None:
            raise _over()
        return record.audit_head

    async def expire_idle(self) -> None:
        """End, every so often and for ever, the sessions that nobody has used for too long, and purge old logs."""
        while True:
            await asyncio.sleep(min(SWEEP_EVERY_S, self._settings.session_idle_s / 2))
            try:
                for session_id in await self._store.unused_since(time.time() - self._settings.session_idle_s):
                    if not self._in_use(session_id):
                        await self._end(session_id, "expired")
                for session_id in [one for one in self._live if not self._in_use(one)]:
                    record = await self._store.get(session_id)
                    if record is None or record.ended_at is not None:  # by another process
                        self._forget(session_id)
                await self._store.purge(time.time() - self._settings.audit_retention_s)
            except Exception:  # a sweep that fails must not be the last one
                logger.exception("idle sessions could not be ended")

    async def current(self, caller: Caller) -> SessionRecord:
        """The session as it is now; it may have moved on, or ended, since the caller was authenticated.

        What another process changed meanwhile may be missing; `decide` finds out.
        """
        session_id = caller.record.session_id
        record = self._store.seen(session_id) or await self._store.get(session_id)
        if record is None or record.ended_at is not None:
            raise _over()
        caller.live.follow(record)
        return record

    async def decide(
        self,
        record: SessionRecord,
        frame: int,
        state: Mapping[str, Any],
        event: AuditEvent,
        messages: bytes | None = None,
    ) -> None:
        """Keep a decision that was worked out from ``record``, its own record, and the commitment to the next seed.

        Raises
        ------
        SessionChanged
            If the session is another by now: the decision is void, and has to be worked out again.
        """
        next_seed = self._seeds()
        event = {**event, "next_seed_commitment": commitment(next_seed)}
        try:
            await self._store.decide(record.session_id, record.revision, frame, state, next_seed, event, messages)
        except SessionOver as error:
            raise _over() from error
        except FrameDecided as error:
            raise Problem(409, "stale-frame", f"frame {frame} or a later one is answered already", "frame") from error
        if messages is not None:
            with contextlib.suppress(StoreUnavailable):  # the decision is kept; the next one forgets these as well
                await self._store.forget_messages(record.session_id, frame - self._settings.keep_frames + 1)

    async def messages(self, caller: Caller, frame: int) -> bytes | None:
        """The messages kept of a decided frame."""
        return await self._store.messages(caller.record.session_id, frame)

    async def _change_team(
        self,
        caller: Caller,
        record: SessionRecord,
        team: Sequence[str],
        token_ids: Mapping[str, str],
        keys: Mapping[str, str],
    ) -> None:
        """Keep a new team of the session ``record``. The session's lock is held."""
        self._check_size(team)
        try:
            state = caller.live.defense.change_team(record.state, team)
        except DomainError as error:
            raise Problem(422, "impossible-defense", str(error), "teammates") from error
        event = audit.team_changed(record.teammates, team, keys, state)
        try:
            await self._store.change_team(
                record.session_id, record.revision, tuple(team), token_ids, keys, state, event
            )
        except SessionChanged as error:
            raise Problem(409, "session-changed", "the session was changed at the same time; try again") from error
        except SessionOver as error:
            raise _over() from error
        caller.live.follow(await self.current(caller))

    def _check_size(self, team: Sequence[str]) -> None:
        most = self._settings.max_teammates
        if len(team) > most:
            raise Problem(422, "too-many-teammates", f"at most {most} teammates are allowed", "teammates")

    def _detector(self, name: str) -> Detector:
        if not self._engine.ready:
            raise Problem(503, "not-ready", "the gateway is still warming up", headers={"Retry-After": "5"})
        if name not in self._engine.detectors:
            known = ", ".join(self._engine.detectors)
            raise Problem(422, "unknown-detector", f"there is no detector of that name; known: {known}", "detector")
        return self._engine.detectors[name]

    def _revive(self, record: SessionRecord) -> LiveSession:
        """What this process holds of a session.

        Raises
        ------
        Problem
            503 if the detector that it was opened with is not served any more, or lacks what the defence needs.
        """
        closed = -1 if record.last_frame is None else record.last_frame
        settings, detector = self._settings, self._engine.detectors.get(record.detector)
        if detector is None:
            raise Problem(503, "detector-unavailable", f"the session's detector {record.detector} is not served now")
        try:
            defense = read_defense(record.defense).build(detector.info)
        except DomainError as error:
            detail = f"the session's detector {record.detector} no longer serves its defence: {error}"
            raise Problem(503, "detector-unavailable", detail) from error
        return LiveSession(
            detector,
            defense,
            record.teammates,
            Gathering(record.teammates, settings.max_pending_frames, self.backlog, closed),
            Motion(settings.max_speed_mps, record.frame_period_ms / 1e3, settings.max_range_m),
            record.latency_budget_ms / 1e3,
        )

    def _in_use(self, session_id: str) -> bool:
        """Whether a frame is in hand, or somebody asked for something lately that left no trace in the store."""
        live = self._live.get(session_id)
        recently = time.monotonic() - self._settings.session_idle_s
        return live is not None and (live.lock.locked() or live.last_used >= recently)

    def _forget(self, session_id: str) -> None:
        live = self._live.pop(session_id, None)
        if live is not None:
            live.gathering.clear()

    async def _end(self, session_id: str, why: str) -> None:
        self._forget(session_id)
        with contextlib.suppress(SessionOver):
            event = audit.session_ended(why)
            logger.info("session ended", session_id=session_id, why=why)
            await self._store.end(session_id, event["time"], event)
        self._metrics.sessions.set(await self._store.count())

    def _is_served(self, record: SessionRecord) -> bool:
        try:
            self._live_session(record)
        except Problem:
            return False
        return True

    def _live_session(self, record: SessionRecord) -> LiveSession:
        live = self._live.get(record.session_id)
        if live is None:
            live = self._live[record.session_id] = self._revive(record)
        return live

    async def _holder(self, record: SessionRecord, token: str | None) -> str:
        """The vehicle of the session that a token belongs to; a refusal goes on record, but only so many of them."""
        try:
            return self._tokens.holder(record, token)
        except TokenRefused as refused:
            live = self._live_session(record) if record.ended_at is None and self._is_served(record) else None
            await self.journal.stranger(record.session_id, live, refused)
            raise refused.problem from refused


def _ego_only(vehicle_id: str) -> Problem:
    return Problem(403, "ego-only", f"only the ego of the session may do this, not {vehicle_id}")


def _over() -> Problem:
    return Problem(404, "unknown-session", "the session has ended")
