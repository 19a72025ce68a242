"""Records of an audit log as plain sentences, for whoever reads a log and not its fields."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from robosac.answers import Distrust, Reason, RejectedTeammate, Source, Standing
from robosac.audit.events import (
    AccessRefused,
    DetectorChanged,
    Equivocation,
    Event,
    FrameAnswered,
    MessageRefused,
    SessionEnded,
    SessionOpened,
    TeamChanged,
    TokenRenewed,
    event_on,
)

REASONS: Mapping[Reason, str] = {
    Reason.DISSENSUS: "in dissensus",
    Reason.NOT_SAMPLED: "no test speaks against it",
    Reason.SUSPECTED: "suspected, though no test of this frame speaks against it",
    Reason.DISTRUSTED: "distrusted",
    Reason.MISSING: "no message came",
    Reason.LATE: "too late",
    Reason.MALFORMED: "malformed",
    Reason.STALE: "stale",
    Reason.UNAUTHENTICATED: "not authenticated",
    Reason.REPLAYED: "replayed",
    Reason.IMPLAUSIBLE: "far larger than honest messages",
    Reason.REPEATED: "a repetition from another place",
    Reason.COPIED: "a copy of another's message",
}
DISTRUSTS: Mapping[Distrust, str] = {
    Distrust.NAMED: "named as an attacker",
    Distrust.UNTRUSTED: "not on the trust list",
    Distrust.EQUIVOCATION: "it sent different messages",
}
_ENDS = {"closed": "The ego closed the session", "expired": "The session expired, as nobody used it"}


def sentence(record: Event | bytes | str) -> str:
    """What a record says, in a sentence.

    Parameters
    ----------
    record : event, bytes or str
        An event, or a line of a log with or without its line break. A sentence may hold words of the record, such as
        ids; before a terminal shows it, take out what is not printable.

    Raises
    ------
    robosac.audit.lines.RecordError
        If a line is no record.
    """
    if isinstance(record, bytes | str):
        line = record.encode() if isinstance(record, str) else record
        event = event_on(line.removesuffix(b"\n"))
        if event is None:
            return "Something happened that this version has no words for."
    else:
        event = record
    return f"{_SENTENCES[type(event)](event)}."


def listed(names: Iterable[str]) -> str:
    """``a, b and c``; ``nobody`` if there are none."""
    *most, last = list(names) or ["nobody"]
    return f"{', '.join(most)} and {last}" if most else last


def _opened(event: SessionOpened) -> str:
    return (
        f"{event.ego_id} opened a session with {listed(event.teammates)}; the detector is {event.detector}, the "
        f"defence {event.defense.get('kind')}, the latency budget {event.latency_budget_ms:g} ms"
    )


def _team(event: TeamChanged) -> str:
    moves = [f"{listed(names)} {verb}" for names, verb in ((event.joined, "joined"), (event.left, "left")) if names]
    return f"{' and '.join(moves) or 'Nobody joined or left'}; the team is now {listed(event.teammates)}"


def _detector(event: DetectorChanged) -> str:
    then = "goes on with them" if event.accepted else "stands still, as they are not the ones that it began with"
    return (
        f"The gateway started again with other weights or another calibration of {event.detector}; the session {then}"
    )


def _answered(event: FrameAnswered) -> str:
    boxes = _number(len(event.boxes), "box", "boxes")
    how = {
        Source.CONSENSUS: f"fused with {listed(event.accepted)}",
        Source.TRUSTED: f"fused with {listed(event.accepted)}, who are on the trust list",
        Source.EGO_ONLY: "of what the ego sees alone",
    }[event.source]
    parts = [f"Frame {event.frame} was answered with {boxes} {how}, after {_number(len(event.hypotheses), 'test')}"]
    if event.rejected:
        why = (f"{name} ({_why(entry)})" for name, entry in event.rejected.items())
        parts.append(f"left out: {', '.join(why)}")
    if event.contradicted:
        parts.append(f"{_number(len(event.contradicted), 'box', 'boxes')} contradicted and left out")
    kept = sum(support.status is Standing.CONTRADICTED for support in event.support or ())
    if kept:
        parts.append(f"{_number(kept, 'box', 'boxes')} contradicted and kept in")
    if event.degraded_by is not None:
        parts.append(f"cut short by {'the deadline' if event.degraded_by == 'deadline' else 'a fault inside'}")
    if not event.deadline_met:
        parts.append("the answer was late")
    parts.extend(_late(event.late))
    if event.unlogged_refusals:
        parts.append(f"{_number(sum(event.unlogged_refusals.values()), 'further refusal')} without a record")
    return "; ".join(parts)


def _why(entry: RejectedTeammate) -> str:
    reason = [] if entry.reason is Reason.DISTRUSTED and entry.distrust else [REASONS[entry.reason]]
    return ", ".join([*reason, *([DISTRUSTS[entry.distrust]] if entry.distrust else [])])


def _refused(event: MessageRefused) -> str:
    no_message = event.frame is None and event.reason is Reason.UNAUTHENTICATED  # such as a teammate's DELETE
    what = "A request" if no_message else "A message"
    frame = "" if event.frame is None else f" for frame {event.frame}"
    field = f"{event.field}: " if event.field else ""
    return f"{what} of {event.vehicle_id}{frame} was refused ({REASONS[event.reason]}): {field}{event.detail}"


def _no_access(event: AccessRefused) -> str:
    who = "Somebody" if event.vehicle_id is None else event.vehicle_id
    return f"{who} came without a token that counts and was turned away: {event.detail}"


def _renewed(event: TokenRenewed) -> str:
    return f"{event.vehicle_id} took a fresh token, which expires at {event.expires_at}"


def _equivocation(event: Equivocation) -> str:
    return f"{event.vehicle_id} sent two different messages for frame {event.frame}"


def _ended(event: SessionEnded) -> str:
    return "; ".join([_ENDS.get(event.why, f"The session ended: {event.why}"), *_late(event.late)])


def _late(frames: Sequence[int]) -> list[str]:
    """What is told afterwards of frames that were to be in time."""
    return [f"the answer to frame {frame} had been late after all" for frame in frames]


def _number(count: int, one: str, more: str = "") -> str:
    return f"{count} {one if count == 1 else more or f'{one}s'}"


_SENTENCES: Mapping[type[Event], Callable[[Any], str]] = {
    SessionOpened: _opened,
    TeamChanged: _team,
    DetectorChanged: _detector,
    FrameAnswered: _answered,
    MessageRefused: _refused,
    AccessRefused: _no_access,
    TokenRenewed: _renewed,
    Equivocation: _equivocation,
    SessionEnded: _ended,
}
