"""Consensus-verified fusion of one frame: runs a defence against a detector under a deadline.

The only place where detector and defence meet. A frame is prepared once; then the defence proposes hypotheses, the
detector decodes them, the consensus test judges, and the defence learns, until it decides or the time is up.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from robosac.ahead import Ahead
from robosac.answers import Reason, Source, Verdict
from robosac.arguments import check_deadline, check_defense, check_frame, check_rng
from robosac.boxes import FloatArray, pose_fault
from robosac.calibrated import witness_of
from robosac.consensus import at_least, compare, overlaps
from robosac.deadline import Deadline
from robosac.defenses import (
    EGO,
    Decision,
    Defense,
    Hypothesis,
    Outcome,
    Reference,
    Rejection,
    State,
    trusted_in,
)
from robosac.defenses.batch import likely_after
from robosac.detectors import Message, Preparer
from robosac.detectors.base import Testifying
from robosac.faults import describe
from robosac.passes import Passes
from robosac.previous import PreviousAnswer
from robosac.provenance import UnverifiedAnswer, best_first
from robosac.result import FusionResult
from robosac.screening import Screened, Screening, joined, separated
from robosac.steps import Steps, finished
from robosac.testimony import Testimony
from robosac.verified import check_asked, check_decided, check_objects, first_state

__all__ = ["FrameRun", "FusionResult", "UnverifiedAnswer", "fuse"]

logger = logging.getLogger(__name__)

READING_SHARE = 0.5
"""Of the time that is left, for testimony: without it there is an answer, without time for a pass there is none."""
T = TypeVar("T")


def fuse(  # all that a decision follows from, so that it can be made again
    detector: Preparer,
    defense: Defense,
    ego: Message,
    teammates: Mapping[str, Message],
    *,
    rng: np.random.Generator,
    state: State | None = None,
    frame: int = 0,
    previous: PreviousAnswer | None = None,
    deadline: Deadline | None = None,
    screening: Screening | None = None,
) -> FusionResult:
    """Answer one frame.

    A fault in fusion or defence does not fail the frame: the ego's own boxes are answered, with ``fault`` set. What
    is no frame of the detector does: `TypeError` or `ValueError`.

    Parameters
    ----------
    detector : Preparer
        Any `Detector`.
    defense : Defense
    ego : Message
    teammates : mapping of teammate id to Message
        Those present in this frame, their numbers finite. Whose pose cannot be is rejected as malformed.
    rng : numpy.random.Generator
        All randomness of the defence.
    state : mapping, optional
        What the defence remembers; by default its initial state for the teammates present.
    frame : int
        The frame's number, for what compares it with the frame before.
    previous : PreviousAnswer, optional
        The latest answer's. A defence with the reference ``previous`` compares with it if it is of the frame before
        this one, else with the ego's own perception.
    deadline : Deadline, optional
        No hypothesis is begun that it has no time for; by default there is time for all. Where nothing is verified or
        trusted, the ego's own perception is computed in any case.
    screening : Screening, optional
        Tests of the messages before any of them is fused; whoever fails them is rejected for the frame. What they
        remember is part of the state. By default there are none.

    Returns
    -------
    FusionResult
    """
    check_defense(defense)
    check_rng(rng)
    check_deadline(deadline)
    check_frame(detector.info, ego, teammates)
    run = FrameRun(detector, defense, ego, frame, previous, deadline or Deadline(), screening)
    return finished(run.answer(teammates, rng, state))


@dataclass
class FrameRun:
    """The state of one call of `fuse`, whose parameters these are."""

    detector: Preparer
    defense: Defense
    ego: Message
    frame: int
    previous: PreviousAnswer | None
    deadline: Deadline
    screening: Screening | None = None
    timings: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(
            ("screening", "prepare", "testimony", "ego_only", "hypotheses", "consensus"), 0.0
        )
    )
    outcomes: list[Outcome] = field(default_factory=list)
    boxes: dict[Hypothesis, FloatArray] = field(default_factory=dict)
    testimony: Testimony | None = None
    unread: tuple[str, ...] = ()
    out_of_time: bool = False
    fault: str | None = None
    _overlaps: dict[Hypothesis, tuple[FloatArray, FloatArray]] = field(default_factory=dict)

    def answer(
        self, teammates: Mapping[str, Message], rng: np.random.Generator, state: State | None
    ) -> Steps[FusionResult]:
        """Answer the frame, with a pause before each pass. Whether a pass still fits is looked at after the pause."""
        team = sorted(teammates)  # the draws must not depend on the order of arrival
        if state is None:
            state = first_state(self.defense, team)
        state, memory = separated(state)
        screened = Screened({}, (), memory)
        nowhere = {name: fault for name in team if (fault := pose_fault(teammates[name].pose))}
        refused = {name: Rejection(Reason.MALFORMED, {"field": "pose", "detail": nowhere[name]}) for name in nowhere}
        try:
            if self.screening is not None:
                yield
                placed = {name: message for name, message in teammates.items() if name not in refused}
                screened = self._screen(self.screening, memory, placed)
                refused |= screened.refused
            passed = {name: teammates[name] for name in team if name not in refused}
            yield
            passes = self._prepare(passed)
            if getattr(self.defense, "asks_witnesses", False):
                yield
                yield from self._hear(passed, trusted_in(state))
            decision = yield from self._converse(passes, list(passed), state, rng)
            answered = yield from self._assemble(passes, decision)
        except Exception as error:
            logger.exception("fusion failed; answering with the ego's own perception")
            self.fault = describe(error)
            passed = {name: teammates[name] for name in team if name not in refused}
            rejected = {name: Rejection(Reason.NOT_SAMPLED, {"fault": self.fault}) for name in passed}
            decision = Decision((), Source.EGO_ONLY, rejected, None, state)
            yield
            answered = yield from self._assemble(self._prepare({}), decision)
        boxes = answered["boxes"]
        decided = {part.name: getattr(decision, part.name) for part in fields(Decision)}
        answered["judge"] = None
        answered["rejected"] = {**decision.rejected, **refused}
        answered["state"] = joined(decision.state, screened.memory)
        return FusionResult(
            **decided | answered,
            alike=screened.alike,
            unread=self.unread,
            hypotheses=tuple(self.outcomes),
            deadline_met=self.deadline.is_met,
            out_of_time=self.out_of_time,
            fault=self.fault,
            timings_ms=self.timings,
            previous=PreviousAnswer.of(self.frame, self.ego.pose, boxes, self.previous) if decision.accepted else None,
        )

    def _screen(self, tests: Screening, memory: State, teammates: Mapping[str, Message]) -> Screened:
        with self._spending("screening"):
            return tests.screen(memory, self.frame, self.ego, teammates)

    def _prepare(self, teammates: Mapping[str, Message]) -> Passes:
        with self._spending("prepare"):
            prepared = self.detector.prepare(self.ego, teammates)
            alone = self.detector.alone if isinstance(self.detector, Ahead) else None
            return Passes(prepared, self.deadline, self.boxes, {} if alone is None else {(): alone})

    def _hear(self, teammates: Mapping[str, Message], trusted: Collection[str]) -> Steps[None]:
        """Ask the witness what each message says by itself, of as many as there is time for: the ego's first, then
        those of teammates that are trusted.
        """
        if hasattr(self.detector, "testify") and isinstance(self.detector, Testifying):  # the first is fast
            with self._spending("testimony"):
                said = self.detector.testify(self.ego, teammates)
                self.testimony = None if said is None else said.of({EGO, *teammates})
        elif (witness := witness_of(self.detector.info)) is not None:
            fits = self.deadline.reading(READING_SHARE)
            known = self.detector.said if isinstance(self.detector, Ahead) else {}
            reading = witness.testify_in_steps(EGO, {EGO: self.ego, **teammates}, trusted, fits, known)
            said = yield from self._paced("testimony", reading)
            self.testimony = None if EGO in said.unread else said
            self.unread = tuple(name for name in said.unread if name != EGO)

    def _paced(self, stage: str, steps: Steps[T]) -> Steps[T]:
        """Do a stage's work with its pauses, which do not count for what it takes."""
        while True:
            with self._spending(stage):
                try:
                    next(steps)
                except StopIteration as stop:
                    result: T = stop.value
                    return result
            with self.deadline.pause():
                yield

    def _converse(self, passes: Passes, team: list[str], state: State, rng: np.random.Generator) -> Steps[Decision]:
        conversation = self.defense.converse(team, state, rng)
        if not isinstance(conversation, Generator):
            raise TypeError(f"{self.defense.kind}: converse must be a generator, which yields hypotheses")
        try:
            batch = next(conversation)
            while True:
                check_asked(self.defense, batch, team)
                batch = conversation.send((yield from self._test(passes, batch)))
        except StopIteration as stop:
            decision: Decision = stop.value
        verified = {o.teammates for o in self.outcomes if o.verdict is Verdict.CONSENSUS}
        check_decided(self.defense, decision, team, verified, set(trusted_in(state)), self.boxes)
        return decision

    def _assemble(self, passes: Passes, decision: Decision) -> Steps[dict[str, Any]]:
        """The fields of the result that hold boxes, and whose they are; judged ones are checked by now."""
        if decision.objects is None:
            found = yield from self._decode(passes, decision.accepted)
            if decision.judge is None or self.testimony is None:
                return {"boxes": found}
            with self._spending("consensus"):
                objects, contradicted = decision.judge(found, self.testimony)
            decision = replace(decision, objects=objects, contradicted=contradicted)
            check_objects(self.defense, decision, self.boxes)
        objects, boxes = best_first(decision.objects or (), self.boxes)
        contradicted, left_out = best_first(decision.contradicted, self.boxes)
        return {"objects": objects, "boxes": boxes, "contradicted": contradicted, "contradicted_boxes": left_out}

    def _test(self, passes: Passes, batch: Sequence[Hypothesis]) -> Steps[list[Outcome]]:
        tested: list[Outcome] = []
        for i, subset in enumerate(batch):
            reference = yield from self._reference(passes, likely_after(batch, i))
            yield from self._before(passes, subset, likely_after(batch, i))
            if not self.deadline.another_fits(passes.takes(subset)):
                self.out_of_time = True
                break
            boxes = self._decoded(passes, subset, likely_after(batch, i))
            with self._spending("consensus"):
                said = self.testimony if self.defense.reference is Reference.EGO else None
                known = None if said is None else partial(said.known_to, EGO)
                confident, iou = self._beside(reference, subset, boxes, passes.ahead)
                comparison = compare(reference, confident, self.defense.consensus_threshold, known, iou)
            index, verdict = comparison.jaccard_index, comparison.verdict
            seen = (boxes, reference, self.ego.pose, self.frame, self.testimony, self.boxes.get(()))
            tested.append(Outcome(subset, index, verdict, *seen))
            self.outcomes.append(tested[-1])
        return tested

    def _beside(
        self, reference: FloatArray, subset: Hypothesis, boxes: FloatArray, ahead: Mapping[Hypothesis, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """A subset's confident boxes, and their IoU with the reference's, which is the same all through the frame.

        It is found with that of all that was decoded with the subset: they are likely to be asked for.
        """
        if subset not in self._overlaps:
            of = {subset: boxes} | {other: ahead[other] for other in ahead if other not in self._overlaps}
            confident = [self._confident(each) for each in of.values()]
            self._overlaps |= zip(of, zip(confident, overlaps(reference, confident), strict=True), strict=True)
        return self._overlaps[subset]

    def _reference(self, passes: Passes, likely: Iterable[Hypothesis]) -> Steps[FloatArray]:
        before = self.previous
        if self.defense.reference is Reference.PREVIOUS and before is not None and before.frame == self.frame - 1:
            return self._confident(before.expected_at(self.ego.pose))
        return self._confident((yield from self._decode(passes, (), likely)))

    def _decode(self, passes: Passes, subset: Hypothesis, likely: Iterable[Hypothesis] = ()) -> Steps[FloatArray]:
        yield from self._before(passes, subset, likely)
        return self._decoded(passes, subset, likely)

    def _before(self, passes: Passes, subset: Hypothesis, likely: Iterable[Hypothesis]) -> Steps[None]:
        """Pause, if it takes a pass to decode a subset. Whoever lets the frame go on may have done it then."""
        if passes.takes(subset):
            yield (coming := passes.coming(subset, likely))
            if coming is not None:
                self.timings[_stage(subset)] += coming.spent_s * 1e3

    def _decoded(self, passes: Passes, subset: Hypothesis, likely: Iterable[Hypothesis]) -> FloatArray:
        with self._spending(_stage(subset)):
            return passes.decode(subset, likely)

    def _confident(self, boxes: FloatArray) -> FloatArray:
        return at_least(boxes, self.detector.info.consensus_score)

    @contextmanager
    def _spending(self, stage: str) -> Iterator[None]:
        started = self.deadline.clock()
        yield
        self.timings[stage] += (self.deadline.clock() - started) * 1e3


def _stage(subset: Hypothesis) -> str:
    """Whose time it is to decode a subset."""
    return "hypotheses" if subset else "ego_only"
