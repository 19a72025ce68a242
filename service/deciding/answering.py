"""From the messages of a frame to its answer: who takes part, fusion, keeping what was decided, telling of it."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import structlog

from robosac import wire
from robosac.answers import FrameAnswer, Reason
from robosac.audit import commitment
from robosac.audit.events import FrameAnswered
from robosac.defenses import Rejection
from robosac.fusion import FusionResult
from service.deciding.admission import Admission
from service.engine import Engine
from service.errors import SessionChanged, StoreUnavailable
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.sessions.gathering import Received
from service.sessions.live import Caller
from service.sessions.sessions import Sessions
from service.watching.metrics import Metrics
from service.watching.tracing import Tracing

logger = structlog.stdlib.get_logger(__name__)

ATTEMPTS = 3
"""To decide a frame while other processes change its session."""


@dataclass
class Asked:
    """A frame that an ego asks about, on its way to an answer."""

    caller: Caller
    """The ego."""
    frame: int
    ego: Received
    """Its own message."""
    arrived: float
    """When its last byte was in (`time.perf_counter`); its budget runs from then."""
    messages: dict[str, Received] = field(default_factory=dict)
    """What teammates sent; whether they are still in the team is looked at later."""
    unusable: dict[str, Rejection] = field(default_factory=dict)
    """Why a part of the body is not among the messages."""
    absences: dict[str, Rejection] = field(default_factory=dict)
    """Why a teammate sent nothing; noted for another attempt, as the gathering forgets it when the frame is closed."""
    timings: dict[str, float] = field(default_factory=dict)
    """Milliseconds."""

    def spent(self, stage: str, since: float) -> None:
        """Note how long a stage took, until now."""
        self.timings[stage] = (time.perf_counter() - since) * 1e3


@dataclass(frozen=True)
class Deciding:
    """Answers frames."""

    sessions: Sessions
    store: Store
    engine: Engine
    metrics: Metrics
    admission: Admission
    tracing: Tracing
    keep_frames: int
    """Latest frames of a session whose messages are kept, to replay decisions."""

    async def answer(self, asked: Asked) -> FrameAnswer:
        """Decide a frame and keep the decision. The session's lock is held.

        What was worked out from a session that another process has changed by then is worked out again.

        Raises
        ------
        SessionChanged
            If the session keeps being changed.
        FrameDecided, SessionOver
            As `service.keeping.store.Store.decide`.
        """
        for _ in range(ATTEMPTS):
            with contextlib.suppress(SessionChanged):
                return await self._decide(asked)
        raise SessionChanged("the session keeps being changed elsewhere; try again")

    async def _decide(self, asked: Asked) -> FrameAnswer:
        """As `answer`, from the session as this process knows it."""
        record = await self.sessions.current(asked.caller)
        present, left_out = self._who_takes_part(asked, record)
        result = await self._fuse(asked, record, present)
        answer = result.answer(asked.frame, left_out, asked.timings, record.ego_id)
        await self._keep(asked, record, present, result, answer)
        self._remember(asked, present, result)
        self._tell(asked, answer, result.fault)
        return answer

    def _who_takes_part(self, asked: Asked, record: SessionRecord) -> tuple[dict[str, Received], dict[str, Rejection]]:
        """Messages of those who can be fused, and why the others of the team cannot; closes the frame."""
        live, ego_pose = asked.caller.live, asked.ego.message.pose
        present, left_out = {}, dict(asked.unusable)
        for name in record.teammates:
            received = asked.messages.get(name)
            if received is None:
                if name not in asked.absences:
                    asked.absences[name] = live.gathering.absence(name, asked.frame)
                left_out.setdefault(name, asked.absences[name])
                continue
            doubt = live.motion.implausible(name, asked.frame, received.message.pose, ego_pose)
            if doubt is None:
                present[name] = received
            else:
                left_out[name] = Rejection(Reason.MALFORMED, {"field": "pose", "detail": doubt})
                self.metrics.refused(Reason.MALFORMED.value)
        live.gathering.close(asked.frame)
        return present, left_out

    async def _fuse(self, asked: Asked, record: SessionRecord, present: Mapping[str, Received]) -> FusionResult:
        live = asked.caller.live
        messages = {name: received.message for name, received in present.items()}
        deadline = self.admission.deadline(asked.arrived, record.latency_budget_ms / 1e3)
        result, asked.timings["queue"] = await self.engine.decide(
            live.session, asked.frame, asked.ego.message, messages, int(record.seed, 16), deadline
        )
        asked.timings.update(result.timings_ms)
        asked.spent("total", asked.arrived)
        return result

    async def _keep(
        self,
        asked: Asked,
        record: SessionRecord,
        present: Mapping[str, Received],
        result: FusionResult,
        answer: FrameAnswer,
    ) -> None:
        """Put the decision on record, with all that it takes to make it again."""
        live, decided = asked.caller.live, time.perf_counter()
        next_seed = self.sessions.draw_seed()
        with live.unlogged() as unlogged:
            event = FrameAnswered(
                **dict(answer),
                seed=record.seed,
                ego_pose=asked.ego.message.pose,
                messages={name: received.proof for name, received in {record.ego_id: asked.ego, **present}.items()},
                previous_frame=None if live.session.previous is None else live.session.previous.frame,
                out_of_time=result.out_of_time,
                fault=result.fault,
                state=dict(result.state),
                unlogged_refusals=unlogged,
                next_seed_commitment=commitment(next_seed),
            )
            body = _whole_frame(asked, present) if self.keep_frames else None
            await self.store.decide(record, event, next_seed, body)
        if body is not None:
            with contextlib.suppress(StoreUnavailable):  # the decision is kept; the next one forgets these as well
                await self.store.forget_messages(record.session_id, asked.frame - self.keep_frames + 1)
        asked.spent("store", decided)
        could_begin = asked.arrived + asked.timings.get("gather", 0.0) / 1e3
        self.admission.learn(could_begin, time.perf_counter(), asked.timings["store"] / 1e3)

    def _remember(self, asked: Asked, present: Mapping[str, Received], result: FusionResult) -> None:
        """What the next frame is judged by."""
        live = asked.caller.live
        live.session.remember(result)
        live.answered, live.ego_digest = asked.frame, asked.ego.digest
        for name, received in {asked.caller.vehicle_id: asked.ego, **present}.items():
            live.motion.moved(name, asked.frame, received.message.pose)

    def _tell(self, asked: Asked, answer: FrameAnswer, fault: str | None) -> None:
        session_id = asked.caller.record.session_id
        self.metrics.frame(answer, asked.timings)
        self.tracing.frame(session_id, answer, asked.timings)
        logger.log(
            logging.DEBUG if answer.degraded_by is None and answer.deadline_met else logging.WARNING,
            "frame answered",
            session_id=session_id,
            frame=asked.frame,
            source=answer.source.value,
            accepted=answer.accepted,
            degraded_by=answer.degraded_by,
            fault=fault,
            deadline_met=answer.deadline_met,
            total_ms=round(asked.timings["total"], 1),
        )


def _whole_frame(asked: Asked, present: Mapping[str, Received]) -> bytes:
    """The messages that were decided from, for a replay."""
    messages = {name: received.message for name, received in present.items()}
    signatures = {name: r.signature for name, r in present.items() if r.signature is not None}
    return wire.pack_frame(asked.frame, asked.ego.message, messages, asked.ego.signature, signatures)
