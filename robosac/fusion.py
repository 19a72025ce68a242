"""Consensus-verified fusion of one frame: runs a defence against a detector under a deadline.

The only place where detector and defence meet. A frame is prepared once; then the defence proposes hypotheses, the
detector decodes them, the consensus test judges, and the defence learns, until it decides or the time is up.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import FloatArray
from robosac.consensus import Verdict, compare
from robosac.defenses import Decision, Defense, Hypothesis, Outcome, Reason, Rejection, Source, State
from robosac.detectors import Detector, Message, PreparedFrame

logger = logging.getLogger(__name__)

SAFETY = 1.2
"""A hypothesis is begun only if this multiple of the dearest pass so far still fits before the deadline."""


class UnverifiedAnswer(Exception):
    """A defence tried to answer with a subset that was not in consensus in this frame."""


@dataclass(frozen=True)
class FusionResult:
    """The answer to one frame.

    Attributes
    ----------
    boxes : (n, 6) float64 ndarray
        x, y, length, width, yaw, score; ego frame, best first.
    source : Source
    accepted : tuple of str
        Teammates whose messages are in the boxes.
    rejected : mapping of teammate id to Rejection
        Every other teammate of the frame.
    hypotheses : tuple of Outcome
        In the order tested.
    attacker_ratio : float or None
        As the defence assumed or estimated it.
    deadline_met : bool
        Whether the answer was ready in time.
    out_of_time : bool
        Whether the defence was cut short to meet the deadline.
    fault : str or None
        What went wrong inside, if anything; the boxes are then the ego's own.
    timings_ms : mapping of stage to float
        ``prepare``, ``ego_only``, ``hypotheses`` (decoding), ``consensus`` (matching).
    state : mapping
        The defence's state for the next frame.
    """

    boxes: FloatArray
    source: Source
    accepted: Hypothesis
    rejected: Mapping[str, Rejection]
    hypotheses: tuple[Outcome, ...]
    attacker_ratio: float | None
    deadline_met: bool
    out_of_time: bool
    fault: str | None
    timings_ms: Mapping[str, float]
    state: State

    @property
    def sampling_steps(self) -> int:
        """Hypotheses tested."""
        return len(self.hypotheses)


def fuse(
    detector: Detector,
    defense: Defense,
    ego: Message,
    teammates: Mapping[str, Message],
    *,
    rng: np.random.Generator,
    state: State | None = None,
    deadline: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> FusionResult:
    """Answer one frame.

    A fault in fusion or defence does not fail the frame: the ego's own boxes are answered, with ``fault`` set.

    Parameters
    ----------
    detector : Detector
    defense : Defense
    ego : Message
    teammates : mapping of teammate id to Message
        Those present in this frame, checked against the detector's layout.
    rng : numpy.random.Generator
        All randomness of the defence.
    state : mapping, optional
        What the defence remembers; its initial state by default.
    deadline : float
        In the clock's time. No hypothesis is begun that is not expected to end before it. The ego's own perception is
        computed in any case.
    clock : callable
        Monotonic, seconds.

    Returns
    -------
    FusionResult
    """
    return _FrameRun(detector, defense, clock, deadline).answer(ego, teammates, rng, state)


@dataclass
class _FrameRun:
    """The state of one call of `fuse`."""

    detector: Detector
    defense: Defense
    clock: Callable[[], float]
    deadline: float
    timings: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("prepare", "ego_only", "hypotheses", "consensus"), 0.0)
    )
    outcomes: list[Outcome] = field(default_factory=list)
    boxes: dict[Hypothesis, FloatArray] = field(default_factory=dict)
    dearest_pass: float = 0.0
    out_of_time: bool = False
    fault: str | None = None

    def answer(
        self, ego: Message, teammates: Mapping[str, Message], rng: np.random.Generator, state: State | None
    ) -> FusionResult:
        if state is None:
            state = self.defense.initial_state()
        prepared, team = self._prepare(ego, teammates)
        started = self.clock()
        ego_only = prepared.detect()
        self._spend("ego_only", started)
        self.dearest_pass = self.clock() - started
        try:
            decision = self._converse(prepared, self._confident(ego_only), team, state, rng)
        except Exception as error:
            decision = self._give_up(teammates, state, error)
        if not team and teammates:
            decision = self._give_up(teammates, state, None)
        return FusionResult(
            boxes=self.boxes[decision.accepted] if decision.accepted else ego_only,
            source=decision.source,
            accepted=decision.accepted,
            rejected=decision.rejected,
            hypotheses=tuple(self.outcomes),
            attacker_ratio=decision.attacker_ratio,
            deadline_met=self.clock() <= self.deadline,
            out_of_time=self.out_of_time,
            fault=self.fault,
            timings_ms=self.timings,
            state=decision.state,
        )

    def _prepare(self, ego: Message, teammates: Mapping[str, Message]) -> tuple[PreparedFrame, list[str]]:
        started = self.clock()
        try:
            return self.detector.prepare(ego, teammates), list(teammates)
        except Exception as error:
            self._note_fault(error)
            return self.detector.prepare(ego, {}), []
        finally:
            self._spend("prepare", started)

    def _converse(
        self, prepared: PreparedFrame, reference: FloatArray, team: list[str], state: State, rng: np.random.Generator
    ) -> Decision:
        conversation = self.defense.converse(team, state, rng)
        try:
            batch = next(conversation)
            while True:
                batch = conversation.send(self._test(prepared, reference, batch))
        except StopIteration as stop:
            decision: Decision = stop.value
        verified = {o.teammates for o in self.outcomes if o.verdict is Verdict.CONSENSUS}
        if decision.accepted and decision.accepted not in verified:
            raise UnverifiedAnswer(f"{self.defense.kind} answered with {decision.accepted}")
        return decision

    def _test(self, prepared: PreparedFrame, reference: FloatArray, batch: Sequence[Hypothesis]) -> list[Outcome]:
        tested: list[Outcome] = []
        for subset in batch:
            started = self.clock()
            if started + SAFETY * self.dearest_pass > self.deadline:
                self.out_of_time = True
                break
            boxes = prepared.detect(subset)
            self._spend("hypotheses", started)
            comparing = self.clock()
            comparison = compare(reference, self._confident(boxes), self.defense.consensus_threshold)
            self._spend("consensus", comparing)
            self.dearest_pass = max(self.dearest_pass, self.clock() - started)
            self.boxes[subset] = boxes
            tested.append(Outcome(subset, comparison.jaccard_index, comparison.verdict))
            self.outcomes.append(tested[-1])
        return tested

    def _confident(self, boxes: FloatArray) -> FloatArray:
        return boxes[boxes[:, 5] >= self.detector.info.consensus_score]

    def _give_up(self, teammates: Mapping[str, Message], state: State, error: Exception | None) -> Decision:
        if error is not None:
            self._note_fault(error)
        rejected = {name: Rejection(Reason.NOT_SAMPLED, {"fault": self.fault}) for name in teammates}
        return Decision((), Source.EGO_ONLY, rejected, None, state)

    def _note_fault(self, error: Exception) -> None:
        logger.exception("fusion failed; answering with the ego's own perception", exc_info=error)
        self.fault = f"{type(error).__name__}: {error}"

    def _spend(self, stage: str, started: float) -> None:
        self.timings[stage] += (self.clock() - started) * 1e3
