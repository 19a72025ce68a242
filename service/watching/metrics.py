"""What the gateway counts, in Prometheus' terms."""

from __future__ import annotations

from collections.abc import Mapping

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    generate_latest,
)

from robosac import __version__
from robosac.answers import FrameAnswer

_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5)


class Metrics:
    """One registry per app, so that several apps of a process do not mix."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        Info("robosac_gateway", "The gateway", registry=self.registry).info({"version": __version__})
        self.sessions = Gauge("robosac_sessions", "Open sessions", registry=self.registry)
        self._frames = Counter("robosac_frames_total", "Answered frames", ["source"], registry=self.registry)
        self._degraded = Counter("robosac_degraded_frames_total", "Frames cut short", ["by"], registry=self.registry)
        self._late = Counter(
            "robosac_late_frames_total", "Frames answered, or given up, after their budget", registry=self.registry
        )
        self._hypotheses = Counter("robosac_hypotheses_total", "Tested hypotheses", ["verdict"], registry=self.registry)
        self._rejected = Counter(
            "robosac_rejected_teammates_total", "Teammates left out of an answer", ["reason"], registry=self.registry
        )
        self._refused = Counter(
            "robosac_refused_messages_total", "Refused messages", ["reason"], registry=self.registry
        )
        self._recorded = Counter("robosac_recorded_frames_total", "Frames recorded", registry=self.registry)
        self._unrecorded = Counter(
            "robosac_unrecorded_frames_total", "Frames left out of recordings", ["why"], registry=self.registry
        )
        for why in ("waiting", "disk"):
            self._unrecorded.labels(why)  # exported from the start, so that a first one is seen as an increase
        self._problems = Counter(
            "robosac_problems_total", "Requests answered with a problem", ["type"], registry=self.registry
        )
        self._stages = Histogram(
            "robosac_stage_seconds", "Time of a frame by stage", ["stage"], buckets=_SECONDS, registry=self.registry
        )

    def frame(self, answer: FrameAnswer, timings_ms: Mapping[str, float]) -> None:
        """Count an answered frame."""
        self._frames.labels(answer.source.value).inc()
        if answer.degraded_by is not None:
            self._degraded.labels(answer.degraded_by).inc()
        if not answer.deadline_met:
            self.late()
        for hypothesis in answer.hypotheses:
            self._hypotheses.labels(hypothesis.verdict.value).inc()
        for rejected in answer.rejected.values():
            self._rejected.labels(rejected.reason.value).inc()
        for stage, milliseconds in timings_ms.items():
            self._stages.labels(stage).observe(milliseconds / 1e3)

    def late(self) -> None:
        """Count a frame that had no answer in time."""
        self._late.inc()

    def refused(self, reason: str) -> None:
        """Count a refused message."""
        self._refused.labels(reason).inc()

    def recorded(self) -> None:
        """Count a frame that is in a recording."""
        self._recorded.inc()

    def unrecorded(self, why: str) -> None:
        """Count a frame that should be in a recording and is not: too many were ``waiting``, or the ``disk`` failed."""
        self._unrecorded.labels(why).inc()

    def problem(self, slug: str) -> None:
        """Count a request that was answered with a problem."""
        self._problems.labels(slug).inc()

    def render(self) -> bytes:
        """The exposition text."""
        return generate_latest(self.registry)
