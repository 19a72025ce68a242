"""How a session begins: what is asked for is checked, what is left open is decided, and both are kept."""

from __future__ import annotations

import secrets
from importlib.metadata import version

import structlog

from robosac.audit import commitment
from robosac.audit.events import SessionOpened, now
from robosac.budget import DomainError
from robosac.calibrated import calibration_digest, calibration_of
from robosac.defenses import DefenseSettings, State
from robosac.detectors import Detector, DetectorInfo
from robosac.session import default_defense, defense_for
from service.engine import Engine
from service.keeping.store import SessionRecord, Store
from service.problems import Problem
from service.schemas import DetectorEntry, SessionCreated, SessionRequest
from service.sessions.identity import Tokens
from service.sessions.sessions import Sessions, check_size
from service.settings import Settings
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)


class Opening:
    """Opens sessions.

    Parameters
    ----------
    settings : Settings
    store : Store
    engine : Engine
    metrics : Metrics
    tokens : Tokens
    sessions : Sessions
    """

    def __init__(
        self, settings: Settings, store: Store, engine: Engine, metrics: Metrics, tokens: Tokens, sessions: Sessions
    ) -> None:
        self._settings = settings
        self._store = store
        self._engine = engine
        self._metrics = metrics
        self._tokens = tokens
        self._sessions = sessions

    async def open(self, request: SessionRequest) -> SessionCreated:
        """Begin a session; the answer is the only place where its tokens are shown.

        Raises
        ------
        Problem
            422 for what cannot be, 503 if the gateway is not warm or holds as many sessions as it may.
        """
        detector = self._detector(self._settings.detector if request.detector is None else request.detector)
        check_size(request.teammates, self._settings.max_teammates)
        defense, state = _defense(request, detector.info)
        budget_ms, gather_ms = self._times(request)
        already_open = await self._count_if_there_is_room()
        session_id = secrets.token_hex(16)
        own = self._tokens.issue(session_id, request.ego_id, is_ego=True)
        others = {name: self._tokens.issue(session_id, name, is_ego=False) for name in request.teammates}
        record = SessionRecord(
            session_id=session_id,
            ego_id=request.ego_id,
            teammates=tuple(request.teammates),
            detector=detector.info.name,
            defense=defense.model_dump(mode="json"),
            latency_budget_ms=budget_ms,
            gather_ms=gather_ms,
            frame_period_ms=request.frame_period_ms,
            token_ids={name: token.token_id for name, token in {request.ego_id: own, **others}.items()},
            public_keys=dict(request.public_keys),
            created_at=now(),
            seed=self._sessions.draw_seed(),
            state=state,
        )
        await self._store.create(record, _first_record(record, detector.info).as_json())
        self._sessions.begin(record)
        self._metrics.sessions.set(already_open + 1)
        logger.info(
            "session opened",
            session_id=record.session_id,
            ego_id=record.ego_id,
            teammates=len(record.teammates),
            detector=record.detector,
            defense=defense.kind,
        )
        return SessionCreated(
            session_id=record.session_id,
            ego_token=own.text,
            teammate_tokens={name: token.text for name, token in others.items()},
            tokens_expire_at=own.expires_at,
            detector=DetectorEntry.of(detector.info),
            defense=defense,
            latency_budget_ms=record.latency_budget_ms,
            gather_ms=record.gather_ms,
            frame_period_ms=record.frame_period_ms,
        )

    def _detector(self, name: str) -> Detector:
        if not self._engine.ready:
            raise Problem(503, "not-ready", "the gateway is still warming up", headers={"Retry-After": "5"})
        if name not in self._engine.detectors:
            known = ", ".join(self._engine.detectors)
            raise Problem(422, "unknown-detector", f"there is no detector of that name; known: {known}", "detector")
        return self._engine.detectors[name]

    def _times(self, request: SessionRequest) -> tuple[float, float]:
        """Latency budget and longest wait for teammates, milliseconds."""
        budget_ms = request.latency_budget_ms or self._settings.latency_budget_ms
        gather_ms = min(self._settings.gather_ms, budget_ms / 2) if request.gather_ms is None else request.gather_ms
        if gather_ms > budget_ms:
            detail = f"must not exceed the latency budget of {budget_ms:g} ms"
            raise Problem(422, "invalid-request", detail, "gather_ms")
        return budget_ms, gather_ms

    async def _count_if_there_is_room(self) -> int:
        """Open sessions."""
        already_open = await self._store.count()
        if already_open >= self._settings.max_sessions:
            detail = "the gateway holds as many sessions as it may"
            raise Problem(503, "too-many-sessions", detail, headers={"Retry-After": "30"})
        return already_open


def _defense(request: SessionRequest, info: DetectorInfo) -> tuple[DefenseSettings, State]:
    """Settings of the session's defence, and its state before the first frame."""
    settings = (request.defense or default_defense(info)).at_period(request.frame_period_ms)
    try:
        if settings.needs_calibration:
            settings = settings.at_calibration(calibration_of(info))
        defense = defense_for(settings, info)
        defense.check_team(len(request.teammates))
    except DomainError as error:
        raise Problem(422, "impossible-defense", str(error), "defense") from error
    return settings, defense.initial_state(request.teammates)


def _first_record(record: SessionRecord, info: DetectorInfo) -> SessionOpened:
    return SessionOpened(
        time=record.created_at,
        version=version("robosac"),
        ego_id=record.ego_id,
        teammates=record.teammates,
        detector=record.detector,
        weights_digest=info.weights_digest,
        calibration_digest=calibration_digest(info),
        defense=dict(record.defense),
        latency_budget_ms=record.latency_budget_ms,
        gather_ms=record.gather_ms,
        frame_period_ms=record.frame_period_ms,
        public_keys=dict(record.public_keys),
        state=dict(record.state),
        next_seed_commitment=commitment(record.seed),
    )
