"""Decisions in a log, and what the log says each was made from."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from robosac.audit.events import DetectorChanged, FrameAnswered, SessionOpened, TeamChanged, event_on
from robosac.audit.lines import RecordError
from robosac.defenses import State
from robosac.previous import PreviousAnswer


class ReplayError(ValueError):
    """A log or messages from which the decision cannot be made again."""


@dataclass(frozen=True)
class LoggedDecision:
    """A decision, and what the log says it was made from."""

    line: int
    """Of the log, from 1 on."""
    session: SessionOpened
    state: State | None
    """What was remembered before the frame; None where the log holds its digest only."""
    state_digest: str | None
    """Its `robosac.audit.packing.state_digest`, where it is in the log."""
    previous: PreviousAnswer | None
    answer: FrameAnswered


def find(lines: Iterable[bytes], frame: int) -> LoggedDecision:
    """The decision about a frame, and all it was made from but the messages.

    Parameters
    ----------
    lines : iterable of bytes
        Of the log. Whether it can be relied on is for `robosac.audit.verify` to say.
    frame : int

    Raises
    ------
    ReplayError
        If the log does not hold the decision, or not what came before it.
    """
    session: SessionOpened | None = None
    state: State | None = {}
    known: str | None = None
    recent: deque[FrameAnswered] = deque(maxlen=2)
    for number, line in enumerate(lines, 1):
        try:
            event = event_on(line.removesuffix(b"\n"))
        except RecordError as error:
            raise ReplayError(f"line {number}: {error}") from error
        if isinstance(event, SessionOpened):
            session = event
        if isinstance(event, DetectorChanged) and event.accepted and session is not None:
            told = {name: getattr(event, name) for name in ("weights_digest", "calibration_digest", "screening")}
            session = session.model_copy(update=told)
        if isinstance(event, FrameAnswered):
            if session is None:
                raise ReplayError("the log does not begin with the session's opening")
            if event.frame == frame:
                return LoggedDecision(number, session, state, known, _before(event, recent), event)
            recent.append(event)
        if isinstance(event, SessionOpened | TeamChanged | FrameAnswered):
            state, known = event.state, getattr(event, "state_digest", None)
    raise ReplayError(f"the log holds no answer to frame {frame}")


def _before(answer: FrameAnswered, recent: Iterable[FrameAnswered]) -> PreviousAnswer | None:
    """The previous answer that a decision was given, with its motion since the answer before it."""
    if answer.previous_frame is None:
        return None
    by_frame = {earlier.frame: earlier for earlier in recent}
    last = by_frame.get(answer.previous_frame)
    if last is None:
        raise ReplayError(f"the log lacks frame {answer.previous_frame}, the previous answer of frame {answer.frame}")
    older = None if last.previous_frame is None else by_frame.get(last.previous_frame)
    then = None if older is None else PreviousAnswer.of(older.frame, older.ego_pose, older.boxes)
    return PreviousAnswer.of(last.frame, last.ego_pose, last.boxes, then)
