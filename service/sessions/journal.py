"""What goes on record besides decisions: who was refused, and who said two things at once. Nobody can fill a log: of
one vehicle, and of all strangers together, only so many records are kept between two frames, and of a whole log they
are a small part (`service.keeping.shares`). The others are counted. So is what came with a token that counts no more by
then: the log has its vehicle under another key, or not at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import structlog

from robosac.answers import Reason
from robosac.audit.events import AccessRefused, Equivocation, Event, MessageRefused, Proof
from service.errors import AuditFull, SessionOver, ShareFull, TokenRefused, TokenReplaced
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.sessions.gathering import Received
from service.sessions.live import EQUIVOCATIONS_LOGGED, REFUSALS_LOGGED, STRANGERS, Caller, LiveSession
from service.watching.metrics import Metrics

logger = structlog.stdlib.get_logger(__name__)


@dataclass(frozen=True)
class Journal:
    """Appends to the logs of sessions."""

    store: Store
    metrics: Metrics

    async def refusal(self, caller: Caller, reason: Reason, detail: str, frame: int | None, field: str) -> None:
        """A vehicle's message, or call, was refused."""
        session_id, vehicle_id = caller.record.session_id, caller.vehicle_id
        if self._counted(caller.live, vehicle_id, reason):
            logger.info(
                "message refused",
                session_id=session_id,
                vehicle_id=vehicle_id,
                reason=reason.value,
                detail=detail,
                frame=frame,
            )
            event = MessageRefused(vehicle_id=vehicle_id, frame=frame, reason=reason, detail=detail, field=field)
            checks = caller.check_token, self.store.shares.check_refusal
            await self._append(caller.live, session_id, vehicle_id, event, *checks)

    async def equivocation(self, caller: Caller, frame: int, first: Proof, second: Received) -> None:
        """A vehicle said two different things about one frame."""
        session_id, vehicle_id = caller.record.session_id, caller.vehicle_id
        proven = caller.live.equivocations[vehicle_id] < EQUIVOCATIONS_LOGGED  # however much was refused before
        caller.live.equivocations[vehicle_id] += proven
        if self._counted(caller.live, vehicle_id, Reason.REPLAYED, proven=proven):
            logger.warning("equivocation", session_id=session_id, vehicle_id=vehicle_id, frame=frame)
            event = Equivocation(vehicle_id=vehicle_id, frame=frame, first=first, second=second.proof)
            checks = caller.check_token, self.store.shares.check_equivocation
            await self._append(caller.live, session_id, vehicle_id, event, *checks)

    async def stranger(self, session_id: str, live: LiveSession | None, refused: TokenRefused) -> None:
        """Somebody came without a token that counts; ``live`` is None for a session not served."""
        if live is None:
            self.metrics.refused(Reason.UNAUTHENTICATED.value)
        elif self._counted(live, STRANGERS, Reason.UNAUTHENTICATED):
            event = AccessRefused(vehicle_id=refused.vehicle_id, detail=refused.detail)
            await self._append(live, session_id, STRANGERS, event, self.store.shares.check_refusal)

    def _counted(self, live: LiveSession, who: str, reason: Reason, *, proven: bool = False) -> bool:
        """Count a refusal, unless it is ``proven``; whether it gets a record."""
        self.metrics.refused(reason.value)
        if proven:
            return True
        is_logged = live.refusals[who] < REFUSALS_LOGGED
        (live.refusals if is_logged else live.unlogged)[who] += 1
        return is_logged

    async def _append(
        self, live: LiveSession, session_id: str, who: str, event: Event, *checks: Callable[[SessionRecord], None]
    ) -> None:
        try:
            await self.store.log(session_id, event, *checks)
        except (AuditFull, ShareFull):
            live.unlogged[who] += 1
        except TokenReplaced:
            live.unlogged[STRANGERS] += 1
        except SessionOver:
            pass
