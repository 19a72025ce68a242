"""How a session begins: what is asked for is checked, what is left open is decided, and both are kept."""

from __future__ import annotations

import asyncio
import secrets
from dataclasses import dataclass, field

import structlog

from robosac import __version__
from robosac.audit import commitment
from robosac.audit.events import SessionOpened, now
from robosac.budget import DomainError
from robosac.calibrated import calibration_digest, calibration_of, screening_for
from robosac.defenses import DefenseSettings, State
from robosac.detectors import DetectorInfo
from robosac.session import default_defense, defense_for
from robosac.verified import check_team_size, first_state
from service.engine import Engine
from service.errors import Kind, Refused
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.schemas import SessionCreated, SessionRequest
from service.sessions.identity import Tokens
from service.sessions.sessions import Sessions
from service.sessions.teams import check_size
from service.settings import Settings
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)


@dataclass(frozen=True)
class Opening:
    """Opens sessions."""

    settings: Settings
    store: Store
    engine: Engine
    metrics: Metrics
    tokens: Tokens
    sessions: Sessions
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    """To be counted and kept: of two that are counted at once, each would find the last place free."""

    async def open(self, request: SessionRequest, key_id: str = "") -> SessionCreated:
        """Begin a session of an API key; the answer is the only place where its tokens are shown.

        Raises
        ------
        Refused
            If it cannot be, the gateway is not warm, or it holds as many sessions as it may.
        """
        info = self._detector(self.settings.detector if request.detector is None else request.detector)
        check_size(request.teammates, self.settings.max_teammates)
        most = self.settings.max_hypotheses
        defense, state = await asyncio.to_thread(_defense, request, info, most)  # files are read the first time
        budget_ms, gather_ms = self._times(request)
        self.sessions.quota.check(key_id)
        session_id = secrets.token_hex(16)
        vehicles = (request.ego_id, *request.teammates)
        tokens = await self.tokens.issue_all(session_id, vehicles, request.ego_id)
        record = SessionRecord(
            session_id=session_id,
            ego_id=request.ego_id,
            teammates=tuple(request.teammates),
            detector=info.name,
            defense=defense.model_dump(mode="json"),
            latency_budget_ms=budget_ms,
            gather_ms=gather_ms,
            frame_period_ms=request.frame_period_ms,
            token_ids={name: token.token_id for name, token in tokens.items()},
            public_keys=dict(request.public_keys),
            created_at=now(),
            seed=self.sessions.draw_seed(),
            state=state,
            key_id=key_id,
            holder=self.sessions.moving.name,
            weights_digest=info.weights_digest,
            calibration_digest=calibration_digest(info),
        )
        first = await asyncio.to_thread(_first_record, record, info)
        async with self.turn:
            already_open = await self._count_if_there_is_room()
            kept = await self.store.create(record, first, self.settings.max_sessions_per_key if key_id else None)
        self.sessions.quota.add(kept)
        self.sessions.begin(record, defense)
        self.metrics.sessions.set(already_open + 1)
        team = {"ego_id": record.ego_id, "teammates": len(record.teammates)}
        logger.info("session opened", session_id=session_id, **team, detector=info.name, defense=defense.kind)
        own = tokens.pop(record.ego_id)
        shown = {
            **vars(record),  # of which only what `SessionCreated` declares is shown
            "ego_token": own.text,
            "teammate_tokens": {name: token.text for name, token in tokens.items()},
            "tokens_expire_at": own.expires_at,
            "detector": info,
            "defense": defense,
            "receipt": self.sessions.keys.receipt(kept),
        }
        return await asyncio.to_thread(SessionCreated.model_validate, shown)

    def _detector(self, name: str) -> DetectorInfo:
        self.engine.check_ready()
        if name not in self.engine.detectors:
            known = ", ".join(self.engine.detectors)
            raise Refused(Kind.UNKNOWN_DETECTOR, f"there is no detector of that name; known: {known}", "detector")
        return self.engine.detectors[name].info

    def _times(self, request: SessionRequest) -> tuple[float, float]:
        """Latency budget and longest wait for teammates, milliseconds."""
        settings = self.settings
        budget_ms = request.latency_budget_ms or min(settings.latency_budget_ms, settings.max_budget_ms)
        default_ms = min(settings.gather_ms, settings.max_gather_ms, budget_ms / 2)
        gather_ms = default_ms if request.gather_ms is None else request.gather_ms
        for name, asked, most in (
            ("latency_budget_ms", budget_ms, settings.max_budget_ms),
            ("gather_ms", gather_ms, settings.max_gather_ms),
        ):
            if asked > most:
                cap = "ROBOSAC_MAX_BUDGET_MS" if name == "latency_budget_ms" else "ROBOSAC_MAX_GATHER_MS"
                raise Refused(Kind.INVALID_REQUEST, f"at most {most:g} ms are allowed ({cap})", name)
        if gather_ms > budget_ms:
            detail = f"must not exceed the latency budget of {budget_ms:g} ms"
            raise Refused(Kind.INVALID_REQUEST, detail, "gather_ms")
        return budget_ms, gather_ms

    async def _count_if_there_is_room(self) -> int:
        """Open sessions."""
        already_open = await self.store.count()
        if already_open >= self.settings.max_sessions:
            raise Refused(Kind.TOO_MANY_SESSIONS, "the gateway holds as many sessions as it may")
        return already_open


def _defense(request: SessionRequest, info: DetectorInfo, most: int) -> tuple[DefenseSettings, State]:
    """Settings of the session's defence, of so many hypotheses a frame at most, and its state before the first one."""
    settings = _within(request.defense or default_defense(info), most).at_period(request.frame_period_ms)
    try:
        if settings.needs_calibration:
            settings = settings.at_calibration(calibration_of(info))
        defense = defense_for(settings, info)
        check_team_size(defense, len(request.teammates))
        return settings, first_state(defense, request.teammates)
    except DomainError as error:
        raise Refused(Kind.IMPOSSIBLE_DEFENSE, str(error), "defense") from error


def _within(defense: DefenseSettings, most: int) -> DefenseSettings:
    """A defence that tests no more hypotheses in a frame than an operator allows.

    A default is lowered. Refused is only what a session asks for itself.
    """
    beyond = [name for name in defense.budgets if (getattr(defense, name) or 0) > most]
    for name in beyond:
        if name in defense.model_fields_set:
            detail = f"at most {most} hypotheses of a frame are tested (ROBOSAC_MAX_HYPOTHESES)"
            raise Refused(Kind.INVALID_REQUEST, detail, f"defense.{name}")
    return defense.model_copy(update=dict.fromkeys(beyond, most))


def _first_record(record: SessionRecord, info: DetectorInfo) -> SessionOpened:
    kept = {name: value for name, value in vars(record).items() if name in SessionOpened.model_fields}
    return SessionOpened(
        **kept,
        time=record.created_at,
        version=__version__,
        screening={name: bounds.as_json() for name, bounds in screening_for(info).bounds.items()},
        next_seed_commitment=commitment(record.seed),
    )
