"""What a load of frames measured."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from clients import trial
from clients.machine import Pace
from robosac.answers import FrameAnswer

WAITS = ("receive", "gather", "queue", "total", "store")
"""Of a frame's timings those that are not work of the detector's thread."""
QUARTILES = 1.349
"""What lies between the quartiles of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Load:
    """One way of loading the gateway."""

    loop: str
    """``closed`` or ``open``."""
    egos: int
    attacked: bool
    """Whether one of the teammates is a PGD attacker."""
    rate_hz: float | None = None
    """Frames a second of each ego, open loop only."""
    teammates: int = 5


@dataclass
class Figures:
    """What one load measured; ``budget_ms`` is the latency budget."""

    load: Load
    budget_ms: float
    seconds: float = 0.0
    latencies_ms: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    engine_ms: list[float] = field(default_factory=list)
    """Of each frame, the work of the detector's thread."""
    within_budget: int = 0
    deadline_met: int = 0
    degraded: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    stages: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    used: Mapping[str, float | None] = field(default_factory=dict)
    """What an answered frame cost, see `clients.metering`; empty if it was not metered."""
    placed: Sequence[int] | None = None
    """Egos that fell to each gateway; None if it is not known."""
    pace: Pace | None = None
    """Of the machine, just before; None if it was not metered."""

    def add(self, answer: FrameAnswer, latency_ms: float) -> None:
        """Count an answer."""
        self.latencies_ms.append(latency_ms)
        self.steps.append(answer.sampling_steps)
        self.within_budget += latency_ms <= self.budget_ms
        self.deadline_met += answer.deadline_met
        self.degraded += answer.degraded_by is not None
        self.engine_ms.append(sum(value for stage, value in answer.timings_ms.items() if stage not in WAITS))
        for stage, milliseconds in answer.timings_ms.items():
            self.stages[stage].append(milliseconds)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; shares are of the frames sent, so a refused frame counts as not answered in time."""
        answered = len(self.latencies_ms)
        sent = answered + sum(self.errors.values())
        return {
            **asdict(self.load),
            "seconds": self.seconds,
            "frames": answered,
            "fps": answered / self.seconds,
            "latency_ms": trial.percentiles(self.latencies_ms),
            "within_budget_share": self.within_budget / max(sent, 1),
            "deadline_met_share": self.deadline_met / max(sent, 1),
            "degraded": self.degraded,
            "sampling_steps_mean": float(np.mean(self.steps)) if answered else None,
            "by_steps": {str(steps): self._tested(steps) for steps in sorted(set(self.steps))},
            "used_a_frame": dict(self.used),
            "placed": self.placed,
            "pace": None if self.pace is None else asdict(self.pace),
            "errors": dict(self.errors),
            "stages_ms": {stage: float(np.median(values)) for stage, values in self.stages.items()},
        }

    def _tested(self, steps: int) -> dict[str, float]:
        """The frames that tested so many hypotheses: how many, and medians of their times."""
        chosen = np.equal(self.steps, steps)
        engine, latency = np.array(self.engine_ms)[chosen], np.array(self.latencies_ms)[chosen]
        low, middle, high = np.percentile(engine, [25, 50, 75])
        return {
            "frames": int(chosen.sum()),
            "engine_ms": float(middle),
            "engine_spread_ms": float(high - low) / QUARTILES,
            "latency_ms": float(np.median(latency)),
        }
