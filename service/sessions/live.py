"""What a session holds in this process only, and who speaks in it."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from robosac.detectors import Detector, Role
from robosac.session import Session
from service.keeping.record import SessionRecord
from service.sessions.gathering import Gathering
from service.sessions.motion import Motion

REFUSALS_LOGGED = 16
"""Refused messages of one vehicle between two frames that get a record each; the others are counted."""
STRANGERS = "?"
"""Under which the refusals of all callers without a token that counts are counted: no vehicle is called so."""


@dataclass
class LiveSession:
    """What a session holds in this process only; the lock is held while a frame is answered or the team changes.

    The store is right about what ``session`` remembers; only the previous answer is known to this process alone. It and
    ``ego_digest`` are of the frame ``answered``, the latest that this process answered.
    """

    session: Session
    detector: Detector
    team: tuple[str, ...]
    gathering: Gathering
    motion: Motion
    budget_s: float
    answered: int | None = None
    ego_digest: str | None = None
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    last_used: float = field(default_factory=time.monotonic)
    refusals: Counter[str] = field(default_factory=Counter)
    renewals: Counter[str] = field(default_factory=Counter)

    def follow(self, record: SessionRecord) -> None:
        """Catch up with what another process did to the session, if one did."""
        if self.team != record.teammates:
            self.team = record.teammates
            self.gathering.change_team(record.teammates)
        if record.last_frame is not None and record.last_frame > self.gathering.closed:
            self.gathering.close(record.last_frame)
        self.session.state = record.state
        if record.last_frame != self.answered:
            self.session.previous = self.ego_digest = None

    @contextmanager
    def unlogged(self) -> Iterator[dict[str, int]]:
        """Refusals by vehicle that got no record since the last decision, for the block that keeps the next one.

        After the block all counts begin again. If it fails, they go on.
        """
        counted, self.refusals = self.refusals, Counter()
        try:
            yield {name: n - REFUSALS_LOGGED for name, n in counted.items() if n > REFUSALS_LOGGED}
        except BaseException:
            self.refusals.update(counted)
            raise
        self.renewals.clear()


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
