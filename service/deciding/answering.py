"""From the messages of a frame to its answer: who takes part, fusion, keeping what was decided, telling of it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass

import structlog

from robosac.answers import FrameAnswer, Reason
from robosac.defenses import Rejection
from service.deciding.admission import Admission
from service.deciding.asked import Answered, Asked
from service.deciding.keeping import Keeping
from service.engine import Engine
from service.errors import SessionChanged, StoreTooSlow
from service.jobs import Decided
from service.keeping.patience import GRACE_S
from service.keeping.record import SessionRecord
from service.sessions.gathering import Received
from service.sessions.sessions import Sessions
from service.turns import Work
from service.viewing.feed import Feed
from service.watching.metrics import Metrics
from service.watching.tracing import Tracing

logger = structlog.stdlib.get_logger(__name__)

ATTEMPTS = 3
"""To decide a frame while other processes change its session."""


@dataclass(frozen=True)
class Deciding:
    """Answers frames."""

    sessions: Sessions
    keeping: Keeping
    engine: Engine
    metrics: Metrics
    admission: Admission
    tracing: Tracing
    feed: Feed

    async def answer(self, asked: Asked, work: Work) -> Answered:
        """Decide a frame, which is work for the engine, and keep the decision. The session's lock is held.

        What was worked out from a session that another process has changed by then is worked out again.

        Raises
        ------
        SessionChanged
            If the session keeps being changed.
        TokenReplaced
            If the ego's token counts no more by now.
        FrameDecided, SessionOver, StoreUnavailable, StoreTooSlow
            As `service.deciding.keeping.Keeping.keep`. The frame can be asked for again, with the messages that are in.
        """
        for _ in range(ATTEMPTS):
            with contextlib.suppress(SessionChanged):
                return await self._decide(asked, work)
        raise SessionChanged("the session keeps being changed elsewhere; try again")

    def tell(self, answered: Answered, answer: FrameAnswer) -> None:
        """Count an answer as it is handed over, log it, and let it be watched."""
        asked, session_id = answered.asked, answered.asked.caller.record.session_id
        self.metrics.frame(answer, asked.timings)
        self.tracing.frame(session_id, answer, asked.timings)
        record, least_score = asked.caller.record, asked.caller.live.detector.info.consensus_score
        poses = {name: asked.messages[name].message.pose for name in record.teammates if name in asked.messages}
        self.feed.note(record, answer, answered.result, asked.ego.message.pose, poses, least_score)
        logger.log(
            logging.DEBUG if answer.degraded_by is None and answer.deadline_met else logging.WARNING,
            "frame answered",
            session_id=session_id,
            frame=asked.frame,
            source=answer.source.value,
            accepted=answer.accepted,
            degraded_by=answer.degraded_by,
            fault=answered.result.fault,
            deadline_met=answer.deadline_met,
            total_ms=round(asked.timings["total"], 1),
        )

    async def settled(self, asked: Asked) -> None:
        """Wait, for so long as the frame may, until the store has let go of the session's decision before."""
        settling = asked.caller.live.settling
        if settling is not None and not settling.done():
            await asyncio.wait({settling}, timeout=max(asked.due - time.perf_counter(), 0.0) + GRACE_S)
            if not settling.done():
                raise StoreTooSlow("is still busy with the frame before; nothing of this one is kept, send it again")
        asked.caller.live.settling = None

    async def _decide(self, asked: Asked, work: Work) -> Answered:
        """As `answer`, from the session as this process knows it."""
        record = await self.sessions.current(asked.caller)
        asked.caller.check_token(record)
        if record.digests != asked.caller.live.digests:
            raise SessionChanged("the session goes on with other weights of its detector; try again")
        present, left_out = self._who_takes_part(asked, record)
        try:
            decided = await self._fuse(asked, work, record, present)
        except BaseException:
            asked.caller.live.gathering.reopen(asked.frame)
            raise
        result, previous = decided.result, asked.caller.live.session.previous
        answer = result.answer(asked.frame, left_out, asked.timings, record.ego_id)
        began = time.perf_counter()
        kept = await self.keeping.keep(asked, record, present, result, answer)
        asked.spent("store", began)
        answer = answer.model_copy(update={"receipt": self.sessions.keys.receipt(kept)})
        rest_ms = asked.timings["receive"] + asked.timings["store"]
        worked_s = decided.worked_s + (0.0 if asked.begun is None else asked.begun.spent_s)  # next time all may be left
        self.admission.learn(record.session_id, worked_s, rest_ms / 1e3, asked.timings["store"] / 1e3)
        return Answered(answer, asked, result, record, previous, tuple(present))

    def _who_takes_part(self, asked: Asked, record: SessionRecord) -> tuple[dict[str, Received], dict[str, Rejection]]:
        """Messages of those who can be fused, and why the others of the team cannot; nothing more is taken for it."""
        live, ego_pose = asked.caller.live, asked.ego.message.pose
        present, left_out = {}, dict(asked.unusable)
        for name in record.teammates:
            received = asked.messages.get(name)
            if received is None:
                if name not in asked.absences:
                    asked.absences[name] = live.gathering.absence(name, asked.frame)
                left_out.setdefault(name, asked.absences[name])
                continue
            if received.key != record.public_keys.get(name):
                detail = "it joined again with another key after its message was checked"
                left_out[name] = Rejection(Reason.UNAUTHENTICATED, {"detail": detail})
            elif doubt := live.motion.implausible(name, asked.frame, received.message.pose, ego_pose):
                field = f"teammates.{name}.pose" if asked.whole else "pose"
                left_out[name] = Rejection(Reason.MALFORMED, {"field": field, "detail": doubt})
                self.metrics.refused(Reason.MALFORMED.value)
            else:
                present[name] = received
        live.gathering.begin(asked.frame)
        return present, left_out

    async def _fuse(self, asked: Asked, work: Work, record: SessionRecord, present: Mapping[str, Received]) -> Decided:
        live = asked.caller.live
        messages = {name: received.message for name, received in present.items()}
        if asked.begun is not None:
            asked.begun.end()
            asked.timings["ahead"] = asked.begun.spent_s * 1e3
        decided = await self.engine.decide(
            live.session,
            asked.frame,
            asked.ego.message,
            messages,
            int(record.seed, 16),
            self.admission.deadline(work),
            work=work,
            ahead=None if asked.begun is None else asked.begun.ahead,
        )
        asked.timings["queue"] = decided.waited_s * 1e3
        asked.timings.update(decided.result.timings_ms)
        asked.spent("total", asked.arrived)
        return decided
