"""A frame on its way to an answer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from robosac.answers import FrameAnswer
from robosac.defenses import Rejection
from robosac.fusion import FusionResult
from robosac.previous import PreviousAnswer
from service.engine import Begun
from service.keeping.record import SessionRecord
from service.sessions.gathering import Received
from service.sessions.live import Caller

Present = Mapping[str, Received]
"""Messages of those who take part, by teammate."""


@dataclass
class Asked:
    """A frame that an ego asks about, on its way to an answer."""

    caller: Caller
    """The ego."""
    frame: int
    ego: Received
    """Its own message."""
    arrived: float
    """When its request came (`time.perf_counter`); its budget runs from then."""
    messages: dict[str, Received] = field(default_factory=dict)
    """What teammates sent; whether they are still in the team is looked at later."""
    unusable: dict[str, Rejection] = field(default_factory=dict)
    """Why a part of the body is not among the messages."""
    absences: dict[str, Rejection] = field(default_factory=dict)
    """Why a teammate sent nothing; noted for another attempt."""
    whole: bool = False
    """Whether all messages came in one body, which is the ego's."""
    begun: Begun | None = None
    """What is worked out while teammates are waited for."""
    timings: dict[str, float] = field(default_factory=dict)
    """Milliseconds."""

    @property
    def due(self) -> float:
        """When its answer is due (`time.perf_counter`)."""
        return self.arrived + self.caller.live.budget_s

    def spent(self, stage: str, since: float) -> None:
        """Note how long a stage took, until now."""
        self.timings[stage] = (time.perf_counter() - since) * 1e3


@dataclass(frozen=True)
class Answered:
    """The answer to a frame, whose decision is kept. What is left is to hand it over, and that takes time, too."""

    answer: FrameAnswer
    """With ``deadline_met`` and ``timings_ms`` as on record: what was known before it was stored."""
    asked: Asked
    result: FusionResult
    """From which it was made."""
    record: SessionRecord
    """The session before the frame."""
    previous: PreviousAnswer | None
    """The answer before it, where that is known."""
    fused: tuple[str, ...]
    """Teammates whose messages took part."""

    @property
    def in_time(self) -> bool:
        """Whether there is still time."""
        return time.perf_counter() <= self.asked.due

    def now(self) -> FrameAnswer:
        """The answer as it is true at this moment."""
        self.asked.spent("total", self.asked.arrived)
        timings = {stage: round(milliseconds, 3) for stage, milliseconds in self.asked.timings.items()}
        return self.answer.model_copy(update={"deadline_met": self.in_time, "timings_ms": timings})
