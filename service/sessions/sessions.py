"""Sessions that are open: who speaks in them, the decisions that they are left with, and their end."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass

import structlog

from robosac.answers import LogReceipt, Reason
from robosac.audit import commitment
from robosac.audit.events import SessionEnded
from robosac.budget import DomainError
from robosac.calibrated import screening_for
from robosac.defenses import DefenseSettings, known, read_settings, suspicion_in
from robosac.session import Session, defense_for
from service.engine import Engine
from service.errors import (
    Kind,
    Refused,
    SessionInUse,
    SessionLost,
    SessionOver,
    StoreTooSlow,
    StoreUnavailable,
    TokenRefused,
)
from service.keeping.gateway_keys import GatewayKeys
from service.keeping.patience import GRACE_S, within
from service.keeping.record import SessionRecord, new_seed
from service.keeping.store import Store
from service.schemas import SessionState
from service.sessions.clock import Clock
from service.sessions.detectors import OTHER_WEIGHTS, detector_changed, has_changed
from service.sessions.gathering import Gathering
from service.sessions.identity import Tokens
from service.sessions.idle import Idle
from service.sessions.journal import Journal
from service.sessions.live import Caller, LiveSession
from service.sessions.motion import Motion
from service.sessions.moving import Moving
from service.sessions.pages import begun, pages
from service.sessions.quota import LogQuota
from service.sessions.room import Room
from service.settings import Settings
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)

COLD_S = 2.0
"""How long the store may take to tell of a session that is not in use here, whose budget is not known yet."""


@dataclass
class Sessions:
    """All sessions of this gateway.

    ``several_keys`` says whether they may be of more than one API key. ``draw_seed`` gives the seed of a frame's draws,
    hexadecimal; by default from the operating system, so that nobody can foresee them. ``on_end`` is told of each
    session that is ended here, by its id.
    """

    settings: Settings
    store: Store
    engine: Engine
    metrics: Metrics
    tokens: Tokens
    keys: GatewayKeys
    several_keys: bool = False
    draw_seed: Callable[[], str] = new_seed
    on_end: Callable[[str], None] = lambda _: None

    def __post_init__(self) -> None:
        self._live: dict[str, LiveSession] = {}
        self._clock = Clock(self.store)
        self._idle = Idle(self.store, self._live, self.settings.session_idle_s, self._clock)
        self._standing: set[str] = set()
        try:
            self.defenses = known(self.settings.extra_defenses)
        except ValueError as fault:
            raise ValueError(f"ROBOSAC_EXTRA_DEFENSES: {fault}") from fault
        of_key = self.settings.max_pending_bytes_per_key if self.several_keys else None  # one key has all to itself
        self.backlog = Room(self.settings.max_pending_bytes, of_key, "ROBOSAC_MAX_PENDING_BYTES")
        self.journal = Journal(self.store, self.metrics)
        self.moving = Moving(self.store)
        self.quota = LogQuota(self.settings.audit_max_bytes_per_key)

    def begin(self, record: SessionRecord, defense: DefenseSettings) -> None:
        """Let a session be used whose record is kept now."""
        self._live[record.session_id] = self._revive(record, defense)

    def drain(self) -> None:
        """Take nothing new: the process is to end, and another goes on with its sessions."""
        self.moving.drain(self._live.values())

    async def authenticate(self, session_id: str, token: str | None, renewal_key: str | None = None) -> Caller:
        """The vehicle that a token belongs to; with a ``renewal_key`` also one before its latest, see `Tokens.holder`.

        Raises
        ------
        Refused
            If the session is unknown or ended, the token is none of it, or its detector or its defence is not served
            any more; or if this process is to end.
        StoreTooSlow
            If the store does not tell within the time that a frame of the session has.
        """
        self.moving.check_open()
        live = self._live.get(session_id)
        patience_s = COLD_S if live is None else live.budget_s + GRACE_S
        try:
            record = await within(self.store.get(session_id), patience_s)
        except TimeoutError:
            detail = "did not say in time who may speak in the session; nothing was done, try again"
            raise StoreTooSlow(detail) from None
        if record is None or record.ended_at is not None:
            self._forget(session_id)
            raise SessionOver("there is no such session; it may have ended or expired")
        vehicle, token_id = await self._holder(record, token, renewal_key)
        is_ego = vehicle == record.ego_id
        try:
            live = self._live_session(record)
        except Refused:
            if is_ego:
                await self._note_other_weights(record)
            raise
        if is_ego and live.has_other_weights:
            record = await self._with_other_weights(record, live)
            live = self._live_session(record)
        live.follow(record)
        live.last_used = time.monotonic()
        return Caller(record, live, vehicle, token_id)

    async def authenticate_ego(self, session_id: str, token: str | None) -> Caller:
        """As `authenticate`, but nobody but the ego is let in."""
        caller = await self.authenticate(session_id, token)
        if not caller.is_ego:
            refused = _ego_only(caller.vehicle_id)
            await self.journal.refusal(caller, Reason.UNAUTHENTICATED, refused.detail, None, "")
            raise refused
        return caller

    def in_use(self, session_id: str) -> LiveSession | None:
        """What this process holds of a session; None if it is not in use here."""
        return self._live.get(session_id)

    async def audit_log(self, session_id: str, token: str | None, after: int, limit: int) -> AsyncIterator[str]:
        """Pages of the log, for the ego; of a session no longer served, too.

        They hold the records numbered above ``after``, at most ``limit`` of them, and end where the log ends now.
        """
        record = await self.store.get(session_id)
        if record is None or record.purging:
            raise SessionOver("there is no such session; its log may have been purged")
        if record.ended_at is None and self._is_served(record):
            await self.authenticate_ego(session_id, token)
        else:
            vehicle, _ = await self._holder(record, token)
            if vehicle != record.ego_id:
                raise _ego_only(vehicle)
        return await begun(pages(self.store, session_id, after, min(record.audit_seq, after + limit)))

    async def describe(self, caller: Caller) -> SessionState:
        """The session's state."""
        record = await self.current(caller)
        shown = {
            **vars(record),  # of which only what `SessionState` declares is shown: no seed, no token's id
            "defense": caller.live.settings,
            "suspicion": suspicion_in(record.state),
            "next_seed_commitment": commitment(record.seed),
            "receipt": self.keys.receipt(record),
        }
        return SessionState.model_validate(shown)

    async def close(self, caller: Caller) -> LogReceipt:
        """End a session, after the frame in hand; the promise of its log, which is complete by then."""
        async with caller.live.lock:
            with contextlib.suppress(SessionOver):  # somebody else has just ended it
                caller.check_token(await self.current(caller))
            await self._end(caller.record.session_id, "closed", None, caller.check_token)
        record = await self.store.get(caller.record.session_id)
        if record is None:
            raise SessionOver
        return self.keys.receipt(record)

    async def expire_idle(self) -> None:
        """`sweep` every so often and for ever."""
        while True:
            await asyncio.sleep(self._idle.every_s)
            await self.sweep()

    async def sweep(self) -> None:
        """Purge old logs, end the sessions that nobody has used for too long, and let go of those that are over here.

        Nothing is purged or ended while this machine's clock is wrong: others may be using it. Nor is anything for
        looking older than it is, as the clock was set forward.
        What fails for one session, or in one step, keeps nothing else from being done.
        """
        with _going_on("there may be no room for the lines of the next days"):
            await self.store.make_ahead()
        is_right = False
        with _going_on("the clock could not be compared with the database's"):
            is_right = await self._clock.is_right()
        with _going_on("logs could not be purged"):
            if is_right:
                kept_s = self.settings.audit_retention_s
                await self.store.purge(time.time() - kept_s - self._clock.stepped_s(kept_s))
        with _going_on("idle sessions could not be ended"):
            unused = await self._idle.unused()  # which tells the store of what is used here, too
            await self._each(unused if is_right else [], self._expire)
        with _going_on("it is unknown which sessions are over"):
            await self._each([one for one in self._live if self._idle.may_be_over(one)], self._forget_if_over)
        with _going_on("it is unknown what is kept for whom"):
            await self.quota.look(self.store)

    async def _each(self, session_ids: Sequence[str], do: Callable[[str], Awaitable[None]]) -> None:
        """Do something for each session, as long as the database answers."""
        for session_id in session_ids:
            with _going_on("a session could not be looked after", session_id=session_id) as failed:
                await do(session_id)
            if failed:
                await self.store.ping()

    async def _expire(self, session_id: str) -> None:
        """End a session, unless it has been used since it was found unused: many may have been ended in between."""
        if self._idle.is_unused_here(session_id):
            with contextlib.suppress(SessionInUse, SessionLost):  # of which the store's log tells
                await self._end(session_id, "expired", self._idle.long_ago())

    async def current(self, caller: Caller) -> SessionRecord:
        """The session as it is now; it may have moved on, or ended, since the caller was authenticated.

        What another process changed meanwhile may be missing; the store finds out when a change is to be kept.
        """
        session_id = caller.record.session_id
        record = self.store.seen(session_id) or await self.store.get(session_id)
        if record is None or record.ended_at is not None:
            raise SessionOver
        caller.live.follow(record)
        return record

    def _revive(self, record: SessionRecord, opened: DefenseSettings | None = None) -> LiveSession:
        """What this process holds of a session. If it was not ``opened`` here just now, with this defence, messages may
        have been sent elsewhere.

        Raises
        ------
        Refused
            If the detector or the defence that it was opened with is not served any more, or the detector lacks what
            the defence needs.
        """
        closed = -1 if record.last_frame is None else record.last_frame
        settings, detector = self.settings, self.engine.detectors.get(record.detector)
        if detector is None:
            detail = f"the session's detector {record.detector} is not served now"
            raise Refused(Kind.DETECTOR_UNAVAILABLE, detail)
        if not self.settings.allow_other_weights and has_changed(record, detector.info):
            raise Refused(Kind.DETECTOR_UNAVAILABLE, f"{OTHER_WEIGHTS} {record.detector}")
        kind = record.defense.get("kind")
        if kind not in self.defenses:
            detail = f"the session's defence {kind} is not served now"
            raise Refused(Kind.DEFENSE_UNAVAILABLE, detail)
        try:
            kept = opened or read_settings(record.defense, self.defenses).at_period(record.frame_period_ms)
            defense = defense_for(kept, detector.info)
        except DomainError as error:
            detail = f"the session's detector {record.detector} no longer serves its defence: {error}"
            raise Refused(Kind.DETECTOR_UNAVAILABLE, detail) from error
        screening = screening_for(detector.info, record.frame_period_ms / 1e3)
        return LiveSession(
            Session(detector, record.teammates, defense, {"state": record.state}, screening=screening),
            kept,
            detector,
            record.teammates,
            record.public_keys,
            record.token_ids,
            Gathering(
                record.teammates,
                settings.max_pending_frames,
                self.backlog.share(record.key_id, record.session_id),
                closed,
                moved=opened is None,
            ),
            Motion(settings.max_speed_mps, record.frame_period_ms / 1e3, settings.max_range_m),
            record.latency_budget_ms / 1e3,
            record.key_id,
            record.digests,
            has_changed(record, detector.info),
        )

    async def _with_other_weights(self, record: SessionRecord, live: LiveSession) -> SessionRecord:
        """The session, which goes on with those that its detector has here from now on."""
        logger.warning("other weights", session_id=record.session_id, detector=record.detector, accepted=True)
        after = await self.store.change_detector(record, detector_changed(live.detector.info, accepted=True))
        live.digests, live.has_other_weights = after.digests, False  # what waits here still counts
        return after

    async def _note_other_weights(self, record: SessionRecord) -> None:
        """A session stands still: put on record, once in the life of a process, that it is for other weights, if so."""
        detector, session_id = self.engine.detectors.get(record.detector), record.session_id
        if detector is not None and has_changed(record, detector.info) and session_id not in self._standing:
            logger.warning("other weights", session_id=session_id, detector=record.detector, accepted=False)
            self._standing.add(session_id)
            await self.store.log(session_id, detector_changed(detector.info, accepted=False))

    def _forget(self, session_id: str) -> None:
        live = self._live.pop(session_id, None)
        if live is not None:
            live.send_away()
            live.gathering.clear()

    async def _forget_if_over(self, session_id: str) -> None:
        """Let go of a session that has ended, or goes on elsewhere."""
        record = await self.store.get(session_id)
        moved = record is not None and self.moving.is_elsewhere(record) and self._idle.may_be_over(session_id)
        if record is None or record.ended_at is not None or moved:
            self._forget(session_id)

    async def _end(
        self,
        session_id: str,
        why: str,
        unused_since: float | None = None,
        *checks: Callable[[SessionRecord], None],
    ) -> None:
        live = self._live.get(session_id)
        if live is not None and live.unsure is not None and (record := await self.store.get(session_id)) is not None:
            live.settle(record)
        ended = SessionEnded(why=why, late=() if live is None else tuple(live.late))
        try:
            await self.store.end(session_id, ended, unused_since, *checks)
            logger.info("session ended", session_id=session_id, why=why)
        except SessionLost:
            self._forget(session_id)
            raise
        except SessionOver:  # already
            pass
        self._forget(session_id)  # not before: if the store fails, the session goes on with the messages that wait
        self.on_end(session_id)
        self.metrics.sessions.set(await self.store.count())

    def _is_served(self, record: SessionRecord) -> bool:
        try:
            self._live_session(record)
        except Refused:
            return False
        return True

    def _live_session(self, record: SessionRecord) -> LiveSession:
        """What this process holds of a session; anew where another process let it go on with other weights since."""
        before = self._live.get(record.session_id)
        if before is not None and before.digests == record.digests:
            return before
        self._forget(record.session_id)
        live = self._live[record.session_id] = self._revive(record)
        if before is not None:
            live.count_on(before)
        return live

    async def _holder(
        self, record: SessionRecord, token: str | None, renewal_key: str | None = None
    ) -> tuple[str, str]:
        """As `Tokens.holder`; a refusal goes on record, but only so many of them."""
        try:
            return self.tokens.holder(record, token, renewal_key)
        except TokenRefused as refused:
            live = self._live_session(record) if record.ended_at is None and self._is_served(record) else None
            await self.journal.stranger(record.session_id, live, refused)
            raise


@contextlib.contextmanager
def _going_on(fault: str, **what: str) -> Iterator[list[str]]:
    """Log what is raised in the block, and go on after it; what it gives is empty unless something was."""
    failed: list[str] = []
    try:
        yield failed
    except Exception as error:
        failed.append(fault)
        logger.error(fault, exc_info=not isinstance(error, StoreUnavailable), **what)  # which is logged already


def _ego_only(vehicle_id: str) -> Refused:
    return Refused(Kind.EGO_ONLY, f"only the ego of the session may do this, not {vehicle_id}")
