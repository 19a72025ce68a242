"""The decisions of a recording made again, as they were or by another defence or detector."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robosac.answers import FrameAnswer
from robosac.audit.replay import agree
from robosac.calibrated import calibration_of, screening_for
from robosac.deadline import Recorded
from robosac.defenses import Defense, Rejection, build, read_settings
from robosac.defenses.registry import Kinds
from robosac.detectors import Detector, Message
from robosac.detectors.base import for_role
from robosac.recording.content import Before
from robosac.recording.reading import RecordedFrame, RecordedSession, RecordingError
from robosac.scenes import SceneError, View, encoded
from robosac.screening import Screening
from robosac.session import Session

NOT_COMPARED = frozenset({"timings_ms", "deadline_met", "receipt"})
"""Fields of an answer that tell of the moment, not of the decision."""


@dataclass(frozen=True)
class Replayed:
    """A frame that was decided again."""

    frame: RecordedFrame
    answer: FrameAnswer
    differing: tuple[str, ...]
    """Fields that came out otherwise, but for the rounding of numbers."""


def replay(
    session: RecordedSession, detector: Detector, defense: Defense | None = None, kinds: Kinds | None = None
) -> Iterator[Replayed]:
    """Decide all frames of a session again, one after another, with the draws that they had.

    Parameters
    ----------
    session : RecordedSession
    detector : Detector
        Any that takes the recorded messages; the one that the session had, for the answers to be the same.
    defense : Defense, optional
        Any. By default the recorded one, from what it remembered then. Another one begins with the first frame to
        remember, and never stops early.
    kinds : mapping, optional
        Where to look for the recorded defence, as `robosac.defenses.read_settings` does.

    Raises
    ------
    RecordingError
        If messages were not recorded, are none for the detector, or the recorded settings make no defence.
    """
    as_it_was = defense is None
    for frame in session.frames[:1]:  # a detector of another layout lacks more than what the defence needs
        _messages(frame, detector, session.opening.ego_id)
    chosen = _recorded_defense(session, detector, kinds) if defense is None else defense
    screening = screening_for(detector.info, session.opening.frame_period_ms / 1e3)
    going: dict[Path | None, tuple[Session, tuple[str, ...]]] = {}
    for frame in session.frames:
        decided = frame.decided
        file = frame.file.path if as_it_was else None  # what a frame goes on from is in its own file
        if as_it_was and decided.before is not None:
            going[file] = _went_on_from(frame, decided.before, detector, chosen, screening), decided.team
        if file not in going:
            going[file] = Session(detector, decided.team, chosen, screening=screening), decided.team
        running, team = going[file]
        if team != decided.team:
            running.change_team(decided.team)
            going[file] = running, decided.team
        messages = _messages(frame, detector, session.opening.ego_id)
        ego = messages.pop(session.opening.ego_id)
        rng = np.random.default_rng(int(decided.seed, 16))
        result = running.decide(frame.number, ego, messages, rng, _deadline(frame) if as_it_was else None)
        running.remember(result)
        answer = result.answer(frame.number, _left_out(frame), {}, session.opening.ego_id)
        yield Replayed(frame, answer, tuple(differing(answer, frame.answer)))


def _went_on_from(
    frame: RecordedFrame, before: Before, detector: Detector, defense: Defense, screening: Screening
) -> Session:
    saved = {"state": before.state, "previous": before.previous}
    try:
        return Session(detector, frame.decided.team, defense, saved, screening=screening)
    except ValueError as error:
        raise RecordingError(f"{frame.file.path}, frame {frame.number}: {error}") from error


def differing(made: FrameAnswer, recorded: FrameAnswer) -> Iterator[str]:
    """Fields in which two answers are not the same."""
    now, then = made.as_json(), recorded.as_json()
    for name in [*then, *(name for name in now if name not in then)]:
        if name not in NOT_COMPARED and not (name in now and name in then and agree(now[name], then[name])):
            yield name


def _recorded_defense(session: RecordedSession, detector: Detector, kinds: Kinds | None) -> Defense:
    try:
        settings = read_settings(session.opening.defense, kinds)
        return build(settings, lambda: calibration_of(detector.info))
    except ValueError as error:
        raise RecordingError(f"the recorded settings make no defence: {error}") from error


def _messages(frame: RecordedFrame, detector: Detector, ego_id: str) -> dict[str, Message]:
    """Those that took part, each with what the detector wants from its sender."""
    held = frame.messages()
    missing = [name for name in (ego_id, *frame.decided.fused) if name not in held]
    if missing:
        raise RecordingError(f"{frame.file.path}, frame {frame.number}: the message of {missing[0]} is missing")
    wanted: Mapping[str, Any] = {ego_id: "ego", **dict.fromkeys(frame.decided.fused, "teammate")}
    try:
        views = {name: View(held[name].pose, np.zeros((0, 3)), message=held[name]) for name in wanted}
        return {name: for_role(encoded(views[name], detector), detector.info, role) for name, role in wanted.items()}
    except (SceneError, KeyError) as error:
        raise RecordingError(f"{frame.file.path}, frame {frame.number}: {error}") from error


def _deadline(frame: RecordedFrame) -> Recorded | None:
    """One that passes when it did."""
    answer, cut_short = frame.answer, frame.decided.out_of_time
    if not cut_short and not answer.unread:
        return None
    return Recorded(len(answer.hypotheses) if cut_short else None, answer.unread)


def _left_out(frame: RecordedFrame) -> dict[str, Rejection]:
    """Why those who did not take part did not."""
    return {
        name: Rejection(entry.reason, dict(entry.model_extra or {}), entry.distrust)
        for name, entry in frame.answer.rejected.items()
        if name not in frame.decided.fused
    }
