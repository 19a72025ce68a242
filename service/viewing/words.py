"""What was decided, in sentences for people who watch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from robosac.answers import FrameAnswer, Reason, RejectedTeammate, Source
from robosac.audit.sentences import DISTRUSTS, listed
from robosac.faults import printable

REASONS: Mapping[Reason, str] = {
    Reason.DISSENSUS: "the ego's own perception contradicts its fusion",
    Reason.NOT_SAMPLED: "no test speaks against it, but the answer is of others",
    Reason.SUSPECTED: "it is suspected, though no test of this frame speaks against it",
    Reason.DISTRUSTED: "it is distrusted",
    Reason.MISSING: "it sent nothing for this frame",
    Reason.LATE: "its message came too late",
    Reason.MALFORMED: "its message is none of the detector, or its pose cannot be",
    Reason.STALE: "it sent a message of an older frame",
    Reason.UNAUTHENTICATED: "nobody knows that it was the sender",
    Reason.REPLAYED: "it sent a message for the second time",
    Reason.IMPLAUSIBLE: "its message holds larger values than honest ones do",
    Reason.REPEATED: "it sent from here what it had sent from another place",
    Reason.COPIED: "it sent what another vehicle had sent",
}
LIES = {
    "ghost": ("vehicle invented", "vehicles invented"),
    "gone": ("vehicle removed", "vehicles removed"),
    "moved": ("vehicle moved", "vehicles moved"),
    "reshaped": ("vehicle turned or resized", "vehicles turned or resized"),
    "late": ("vehicle moved along itself", "vehicles moved along themselves"),
    "veiled": ("change that its own message denies", "changes that its own message denies"),
    "alone": ("vehicle removed that one other sees", "vehicles removed that one other sees"),
    "straying": ("move of many vehicles by a little", "moves of many vehicles by a little"),
}


def of_frame(answer: FrameAnswer) -> str:
    """How a frame was answered."""
    whose = {
        Source.CONSENSUS: f"fused with {listed(answer.accepted)}",
        Source.TRUSTED: f"fused with {listed(answer.accepted)}, who are on the trust list",
        Source.EGO_ONLY: "that the ego sees alone",
    }[answer.source]
    said = f"Frame {answer.frame} was answered with {_count(len(answer.boxes), 'box', 'boxes')} {whose}"
    out = ", ".join(f"{printable(name)} ({_short(entry)})" for name, entry in answer.rejected.items())
    cut = {None: "", "deadline": "; there was no time for more tests", "fault": "; something failed inside"}
    return said + (f"; left out: {out}" if out else "") + cut[answer.degraded_by] + "."


def of_rejection(entry: RejectedTeammate) -> str:
    """Why a teammate was left out."""
    parts = [DISTRUSTS[entry.distrust]] if entry.distrust is not None else []
    if entry.reason is not Reason.DISTRUSTED or entry.distrust is None:
        parts.append(REASONS[entry.reason])
    more: Mapping[str, Any] = entry.model_extra or {}
    if tests := more.get("hypotheses"):
        lowest = more.get("lowest_jaccard_index", math.nan)
        which = listed(str(test + 1) for test in tests)
        parts.append(f"{'test' if len(tests) == 1 else 'tests'} {which} of this frame: agreement down to {lowest:.2f}")
    if isinstance(off := more.get("misplaced_m"), float):
        parts.append(f"its message is out of place by {off:.1f} m")
    if more.get("ego_astray") is True:
        parts.append("the ego itself is not where it says")
    if detail := more.get("detail"):
        parts.append(printable(str(detail)))
    if (other := more.get("of")) is not None:
        parts.append(f"from {printable(str(other))}")
    return "; ".join(parts)


def of_evidence(entry: RejectedTeammate) -> list[str]:
    """What speaks for it that a teammate attacks, item by item, what counts most first; and what speaks against it."""
    items = [item for item in (entry.model_extra or {}).get("evidence", ()) if isinstance(item, Mapping)]
    items.sort(key=lambda item: -abs(item.get("log_likelihood_ratio", 0.0)))
    return [_item(item) for item in items]


def _short(entry: RejectedTeammate) -> str:
    return DISTRUSTS[entry.distrust] if entry.distrust is not None else entry.reason.value.replace("_", " ")


def _item(item: Mapping[str, Any]) -> str:
    words = _TESTS.get(str(item.get("test")))
    said = words(item) if words else f"the test {item.get('test')}"
    return f"Frame {item.get('frame')} of those judged: {said}. {_weight(item.get('log_likelihood_ratio', 0.0))}"


def _weight(log_ratio: float) -> str:
    """A likelihood ratio in words."""
    if abs(log_ratio) < 0.05:
        return "That changes little."
    times = math.exp(min(abs(log_ratio), 50.0))
    amount = f"{times:.2g}" if times < 10 else f"{times:,.0f}" if times < 1e6 else f"{times:.0e}"
    return f"That makes an attack {amount} times {'more' if log_ratio > 0 else 'less'} likely."


def _difference(item: Mapping[str, Any]) -> str:
    lost, new = item.get("loss", math.nan), item.get("novelty", 0)
    added = f"{_count(new, 'box', 'boxes')} that {'touches' if new == 1 else 'touch'} none of them"
    there = "there is" if new == 1 else "there are"
    return f"{lost:.0%} of the overlap with the boxes of before is lost, and {there} {added}"


def _ego(item: Mapping[str, Any]) -> str:
    fused, index = listed(item.get("teammates", ())), item.get("jaccard_index", math.nan)
    return f"fused with {fused}, beside what the ego sees alone, {_difference(item)} (agreement {index:.2f})"


def _pair(item: Mapping[str, Any]) -> str:
    joining = listed(item.get("joining", ()))
    return f"when {joining} joined {listed(item.get('teammates', ()))}, {_difference(item)}"


def _change(item: Mapping[str, Any]) -> str:
    fused = listed(item.get("teammates", ()))
    return f"fused with {fused}, {item.get('changes')} of {item.get('boxes')} boxes came or went since the frame before"


def _objects(item: Mapping[str, Any]) -> str:
    kinds = item.get("kinds", {})
    lies = [_count(number, *LIES.get(kind, (kind, kind))) for kind, number in kinds.items()]
    places = "; ".join(f"({x:.1f}, {y:.1f})" for x, y in item.get("places", ()))
    near = f", near {places} in the world's metres" if places else ""
    conflicts = item.get("conflicts", 0)
    alone = f", and {_count(conflicts, 'box', 'boxes')} over which it alone says the contrary" if conflicts else ""
    return f"{listed(lies) if lies else 'no single lie'}{near}{alone}"


def _count(number: int, one: str, more: str) -> str:
    return f"{number} {one if number == 1 else more}"


_TESTS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "ego": _ego,
    "pair": _pair,
    "change": _change,
    "objects": _objects,
}
