"""A decision made again from its record and the messages that were kept of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac import decimals, wire
from robosac.answers import ContradictedBox, Support, TestedHypothesis
from robosac.audit.decisions import LoggedDecision, ReplayError, find
from robosac.audit.events import FrameAnswered
from robosac.audit.packing import state_digest
from robosac.boxes import BOX_UNITS, FloatArray
from robosac.budget import DomainError
from robosac.calibrated import calibration_digest, calibration_of
from robosac.deadline import Recorded
from robosac.defenses import Defense, Kinds, Outcome, State, build, read_settings
from robosac.detectors import Message, Preparer
from robosac.detectors.base import split_precision
from robosac.faults import in_short
from robosac.fusion import FusionResult
from robosac.screening import MEMORY, Bounds, Screening
from robosac.session import Session

__all__ = ["Difference", "LoggedDecision", "ReplayError", "find", "replay"]

JACCARD_TOLERANCE = 1e-9
STATE_TOLERANCE = 2e-6
"""What it holds of boxes is rounded to 1e-6."""
BOX_TOLERANCE = 1e-6
"""Metres, radians and score: what another order of summation may change."""
WHOLE = 1e-6
"""As near to a whole number of units a logged value is taken to be rounded."""


@dataclass(frozen=True)
class Difference:
    """What came out otherwise."""

    what: str
    """``detector`` or ``messages``: other inputs, and nothing was recomputed; else the field of the answer."""
    detail: str
    """For a human."""

    def __str__(self) -> str:
        return f"{self.what}: {self.detail}"


def replay(decision: LoggedDecision, body: bytes, detector: Preparer, kinds: Kinds | None = None) -> list[Difference]:
    """Make a decision again and compare.

    Jaccard indices are compared to `JACCARD_TOLERANCE`, boxes to `BOX_TOLERANCE`, the defence's state to
    `STATE_TOLERANCE`; times are not. A decision that the deadline cut short is made again with one that passes after as
    many hypotheses. Where the log holds only the digest of what was remembered, the body has to hold it.

    Parameters
    ----------
    decision : LoggedDecision
    body : bytes
        The messages, as a whole frame (`robosac.wire.read_frame`), as the gateway keeps it.
    detector : Preparer
        The one that the session had.
    kinds : mapping, optional
        Where to look for the session's defence, as `robosac.defenses.read_settings` does.

    Returns
    -------
    list of Difference
        Empty if the decision comes out the same. Other inputs are reported without a replay.

    Raises
    ------
    ReplayError
        If the messages cannot be read, or the log's settings make no defence.
    """
    logged = decision.answer
    if detector.info.weights_digest != decision.session.weights_digest:
        detail = f"the weights' digest is {detector.info.weights_digest}, logged {decision.session.weights_digest}"
        return [Difference("detector", detail)]
    _, precision = split_precision(decision.session.detector)
    if detector.info.precision != precision:
        return [Difference("detector", f"the precision is {detector.info.precision}, logged {precision}")]
    calibration = calibration_digest(detector.info)
    try:
        settings = read_settings(decision.session.defense, kinds)
        if settings.needs_calibration and calibration != decision.session.calibration_digest:
            detail = f"the calibration's digest is {calibration}, logged {decision.session.calibration_digest}"
            return [Difference("detector", detail)]
        defense = build(settings, lambda: calibration_of(detector.info))
    except DomainError as error:
        raise ReplayError(f"the log's settings make no defence: {error}") from error
    messages, states = _read_messages(decision, body, detector)
    wrong = list(_compare_digests(logged, messages))
    if wrong:
        return wrong
    before = decision.state if decision.state is not None else _kept_state(states, "before", decision.state_digest)
    if before is None:
        raise ReplayError("the log has only the digest of what was remembered before, the messages lack it")
    after = logged.state if logged.state is not None else _kept_state(states, "after", logged.state_digest)
    made = _fuse(decision, before, defense, messages, detector)
    differences = [*_compare(logged, made), *_compare_state(logged, after, made)]
    return [*differences, *_compare_provenance(decision, made)]


def _read_messages(
    decision: LoggedDecision, body: bytes, detector: Preparer
) -> tuple[dict[str, Message], Mapping[str, bytes]]:
    """The messages, and what was remembered before and after, where that was kept."""
    ego_id = decision.session.ego_id
    try:
        envelope = wire.read_frame(body)
        if envelope.frame != decision.answer.frame:
            raise ReplayError(f"the messages are of frame {envelope.frame}, not {decision.answer.frame}")
        messages = {ego_id: wire.check_message(envelope.ego, detector.info, "ego", "ego")}
        for name, payload in envelope.teammates.items():
            messages[name] = wire.check_message(payload, detector.info, "teammate", f"teammates.{name}")
    except wire.WireError as error:
        raise ReplayError(f"not the messages of a frame: {error}") from error
    return messages, envelope.states


def _kept_state(states: Mapping[str, bytes], which: str, digest: str | None) -> State | None:
    """A state that was kept with the messages; None if it is not the one in the log."""
    try:
        state: State = json.loads(states.get(which, b""))
        return state if state_digest(state) == digest else None
    except (ValueError, TypeError, RecursionError):
        return None


def _compare_digests(logged: FrameAnswered, messages: dict[str, Message]) -> Iterator[Difference]:
    for name in sorted(logged.messages.keys() | messages.keys()):
        if name not in messages:
            yield Difference("messages", f"that of {name} is missing")
        elif name not in logged.messages:
            yield Difference("messages", f"that of {name} is not in the log")
        elif wire.content_digest(logged.frame, name, messages[name]) != logged.messages[name].digest:
            yield Difference("messages", f"that of {name} is not the one in the log")


def _fuse(
    decision: LoggedDecision, state: State, defense: Defense, messages: dict[str, Message], detector: Preparer
) -> FusionResult:
    logged, previous = decision.answer, decision.previous
    saved = {"state": state, "previous": None if previous is None else previous.as_json()}
    try:
        session = Session(detector, decision.session.teammates, defense, saved, screening=_screening(decision))
    except DomainError as error:
        raise ReplayError(f"the log's team makes no session: {error}") from error
    teammates = dict(messages)
    ego = teammates.pop(decision.session.ego_id)
    cut_short = logged.out_of_time or logged.unread
    deadline = Recorded(len(logged.hypotheses) if logged.out_of_time else None, logged.unread) if cut_short else None
    return session.decide(logged.frame, ego, teammates, np.random.default_rng(int(logged.seed, 16)), deadline)


def _screening(decision: LoggedDecision) -> Screening | None:
    """The tests of messages that the frame was put to."""
    if not _was_screened(decision):
        return None
    known = decision.session.screening or {}
    bounds = {name: Bounds.from_json(dict(fields)) for name, fields in known.items()}
    return Screening(bounds, decision.session.frame_period_ms / 1e3)


def _was_screened(decision: LoggedDecision) -> bool:
    """Whether messages were tested: what the tests remember tells it, or where that is not at hand, the opening."""
    state = decision.answer.state
    return decision.session.screening is not None if state is None else MEMORY in state


def _compare_state(logged: FrameAnswered, after: State | None, made: FusionResult) -> Iterator[Difference]:
    if after is not None:
        if not agree(dict(made.state), dict(after)):
            yield Difference("state", f"{_shown(dict(made.state))}, logged {_shown(dict(after))}")
    elif (digest := state_digest(made.state)) != logged.state_digest:
        yield Difference("state", f"of digest {digest}, logged {logged.state_digest}")


def _compare(logged: FrameAnswered, made: FusionResult) -> Iterator[Difference]:
    reasons = {name: why.reason.value for name, why in logged.rejected.items()}
    compared: list[tuple[str, Any, Any]] = [
        ("fault", made.fault, None if logged.fault is None else in_short(logged.fault)),
        ("out_of_time", made.out_of_time, logged.out_of_time),
        ("source", made.source.value, logged.source.value),
        ("accepted", list(made.accepted), list(logged.accepted)),
    ]
    for name, why in made.rejected.items():
        compared.append(("rejected", f"{name} {why.reason.value}", f"{name} {reasons.get(name)}"))
    for what, now, then in compared:
        if not agree(now, then):
            yield Difference(what, f"{_shown(now)}, logged {_shown(then)}")
    yield from _compare_hypotheses(logged, made)
    if made.boxes.shape != logged.boxes.shape:
        yield Difference("boxes", f"{len(made.boxes)} of them, logged {len(logged.boxes)}")
    elif (farthest := _farthest(made.boxes, logged.boxes)) > BOX_TOLERANCE:
        yield Difference("boxes", f"up to {farthest:.3g} from those logged")


def _farthest(made: FloatArray, logged: FloatArray) -> float:
    """How far boxes (n, 6) are from those logged, beyond what they may be by being rounded in the log."""
    units = np.array(BOX_UNITS, dtype=np.float64)
    rounded = np.abs(logged * units - np.round(logged * units)) < WHOLE
    apart = np.abs(made - logged) - np.where(rounded, 0.5 / units, 0.0)
    return float(apart.max(initial=0.0))


def _compare_provenance(decision: LoggedDecision, made: FusionResult) -> Iterator[Difference]:
    """On whose word boxes stand, which are left out, and whose maps are alike; older versions wrote none of it."""
    logged, ego_id = decision.answer, decision.session.ego_id
    alike = [[each.as_json() for each in both] for both in (made.likenesses(ego_id), logged.alike)]
    if _was_screened(decision) and not agree(*alike):
        yield Difference("alike", f"{_shown(alike[0])}, logged {_shown(alike[1])}")
    supports: list[tuple[str, Sequence[Support] | None, Sequence[Support] | None]] = [
        ("support", made.support(ego_id), logged.support),
        ("contradicted", made.left_out(ego_id), logged.contradicted),
    ]
    for what, now, then in supports:
        if what not in logged.model_fields_set:
            continue
        if now is None or then is None or len(now) != len(then):
            if now != then:
                yield Difference(what, f"{_counted(now)}, logged {_counted(then)}")
            continue
        for i, (mine, theirs) in enumerate(zip(now, then, strict=True)):
            if _whose(mine) != _whose(theirs):
                yield Difference(what, f"box {i}: {_shown(_whose(mine))}, logged {_shown(_whose(theirs))}")
            elif isinstance(mine, ContradictedBox) and isinstance(theirs, ContradictedBox):
                farthest = _farthest(np.array(mine.box), np.array(theirs.box))
                if farthest > BOX_TOLERANCE:
                    yield Difference(what, f"box {i}: up to {farthest:.3g} from the one logged")


def _whose(support: Support) -> list[Any]:
    return [support.status.value, list(support.witnesses), list(support.deniers)]


def _counted(supports: Sequence[Support] | None) -> str:
    return "not known" if supports is None else f"that of {len(supports)} boxes"


def _compare_hypotheses(logged: FrameAnswered, made: FusionResult) -> Iterator[Difference]:
    if len(made.hypotheses) != len(logged.hypotheses):
        yield Difference("hypotheses", f"{len(made.hypotheses)} of them, logged {len(logged.hypotheses)}")
        return
    for i, (now, then) in enumerate(zip(made.hypotheses, logged.hypotheses, strict=True)):
        apart = abs(now.jaccard_index - then.jaccard_index) > JACCARD_TOLERANCE
        if apart or (now.teammates, now.verdict) != (then.teammates, then.verdict):
            yield Difference("hypotheses", f"{i}: {_told(now)}, logged {_told(then)}")


def _told(tested: Outcome | TestedHypothesis) -> str:
    return f"{', '.join(tested.teammates)}: {tested.jaccard_index:.9g} ({tested.verdict})"


def agree(now: Any, then: Any) -> bool:
    """Whether two JSON values are the same but for the rounding of their numbers."""
    if isinstance(now, Mapping) and isinstance(then, Mapping):
        return now.keys() == then.keys() and all(agree(now[key], then[key]) for key in now)
    if isinstance(now, list | tuple) and isinstance(then, list | tuple):
        return len(now) == len(then) and all(agree(a, b) for a, b in zip(now, then, strict=True))
    if isinstance(now, float) and isinstance(then, int | float):
        return math.isclose(now, then, rel_tol=STATE_TOLERANCE, abs_tol=STATE_TOLERANCE)
    if decimals.is_text(now) and decimals.is_text(then):
        ours, logged = decimals.from_text(now), decimals.from_text(then)
        return ours.shape == logged.shape and np.allclose(ours, logged, rtol=STATE_TOLERANCE, atol=STATE_TOLERANCE)
    return bool(now == then)


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 200 else f"{text[:200]}..."
