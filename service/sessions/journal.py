"""What goes on record besides decisions: who was refused, and who said two things at once. Nobody can fill a log: of
one vehicle, and of all strangers together, only so many records are kept between two frames; the others are counted.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import structlog

from robosac.answers import Reason
from robosac.audit.events import AccessRefused, Equivocation, Event, MessageRefused, Proof
from service.errors import AuditFull, SessionOver, TokenRefused
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
            await self._append(session_id, event)

    async def equivocation(self, caller: Caller, frame: int, first: Proof, second: Received) -> None:
        """A vehicle said two different things about one frame."""
        session_id, vehicle_id = caller.record.session_id, caller.vehicle_id
        caller.live.equivocations[vehicle_id] += 1
        proven = caller.live.equivocations[vehicle_id] <= EQUIVOCATIONS_LOGGED  # however much was refused before
        if self._counted(caller.live, vehicle_id, Reason.REPLAYED, logged=proven):
            logger.warning("equivocation", session_id=session_id, vehicle_id=vehicle_id, frame=frame)
            event = Equivocation(vehicle_id=vehicle_id, frame=frame, first=first, second=second.proof)
            await self._append(session_id, event)

    async def stranger(self, session_id: str, live: LiveSession | None, refused: TokenRefused) -> None:
        """Somebody came without a token that counts; ``live`` is None for a session not served."""
        if live is None:
            self.metrics.refused(Reason.UNAUTHENTICATED.value)
        elif self._counted(live, STRANGERS, Reason.UNAUTHENTICATED):
            await self._append(session_id, AccessRefused(vehicle_id=refused.vehicle_id, detail=refused.detail))

    def _counted(self, live: LiveSession, who: str, reason: Reason, *, logged: bool = False) -> bool:
        """Count a refusal, unless it is ``logged`` anyway; whether it gets a record."""
        self.metrics.refused(reason.value)
        live.refusals[who] += not logged
        return logged or live.refusals[who] <= REFUSALS_LOGGED

    async def _append(self, session_id: str, event: Event) -> None:
        with contextlib.suppress(SessionOver, AuditFull):
            await self.store.log(session_id, event)
