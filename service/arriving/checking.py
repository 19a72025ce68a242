"""Bodies of messages and whole frames, checked: in steps, off the event loop where a body is large."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from robosac import wire
from robosac.answers import Reason
from robosac.defenses import Rejection
from robosac.detectors import Role
from robosac.recording.truth import read_truth
from robosac.signatures import is_valid, read_public_key
from robosac.steps import Steps
from service.errors import Kind, Refused, Unusable
from service.sessions.gathering import Received
from service.sessions.live import Caller

STRANGERS_NAMED = 8
NAME_CHARACTERS = 64
"""Of a stranger's name that are shown; no vehicle's id has more."""


class InFrame(Exception):
    """What is wrong with a body, and the frame that it is for, as far as that is known."""

    def __init__(self, what: wire.WireError | Unusable, frame: int | None) -> None:
        super().__init__(what, frame)
        self.what = what
        self.frame = frame


@dataclass
class Parts:
    """The messages of a whole frame, by what came of checking them."""

    ego: Received
    messages: dict[str, Received] = field(default_factory=dict)
    """Of the teammates whose messages are good."""
    unusable: dict[str, Rejection] = field(default_factory=dict)
    """Why others are not among them."""
    malformed: list[str] = field(default_factory=list)
    """Those of them who are enrolled."""


def read_message(caller: Caller, body: bytes) -> Steps[tuple[int, Received]]:
    """A vehicle's own message and its frame's number; in one step.

    Raises
    ------
    InFrame
    """
    frame = None
    try:
        envelope = wire.read_message(body)
        frame = envelope.frame
        if envelope.vehicle_id != caller.vehicle_id:
            detail = f"the token of {caller.vehicle_id} cannot speak for another vehicle"
            raise Unusable(Kind.WRONG_VEHICLE, Reason.UNAUTHENTICATED, detail, "vehicle_id")
        return frame, check(caller, caller.vehicle_id, frame, envelope.payload, "")
    except (wire.WireError, Unusable) as error:
        raise InFrame(error, frame) from error
    yield


def read_frame(caller: Caller, body: bytes) -> Steps[tuple[int, Parts]]:
    """A whole frame and its number; only what is wrong with the ego's part is wrong with all of it. It pauses before
    each teammate's part.

    Raises
    ------
    InFrame
    """
    frame = None
    try:
        envelope = wire.read_frame(body, caller.record.teammates)
        frame = envelope.frame
        parts = Parts(check(caller, caller.vehicle_id, frame, envelope.ego, "ego"))
    except (wire.WireError, Unusable) as error:
        raise InFrame(error, frame) from error
    for name in caller.record.teammates:
        if name not in envelope.teammates and name not in envelope.unreadable:
            continue
        yield
        try:
            if name in envelope.unreadable:
                raise envelope.unreadable[name]
            parts.messages[name] = check(caller, name, frame, envelope.teammates[name], f"teammates.{name}")
        except (wire.WireError, Unusable) as error:
            parts.unusable[name] = Rejection(reason_of(error), {"field": error.field, "detail": error.detail})
            parts.malformed.append(name)
    known = {caller.record.ego_id, *caller.record.teammates}
    strangers = [name for name in (*envelope.teammates, *envelope.unreadable) if name not in known]
    for name in strangers[:STRANGERS_NAMED]:
        parts.unusable[_shown(name)] = Rejection(Reason.UNAUTHENTICATED, {"detail": "not enrolled in this session"})
    return frame, parts


def _shown(stranger: str) -> str:
    """A stranger's name, shortened; what is cut off leaves a mark, which no id has, so that it names nobody else."""
    return stranger if len(stranger) <= NAME_CHARACTERS else f"{stranger[: NAME_CHARACTERS - 1]}…"


def reason_of(error: wire.WireError | Refused) -> Reason:
    """What goes on record of a message that does not count."""
    return error.reason if isinstance(error, Unusable) else Reason.MALFORMED


def check(caller: Caller, vehicle: str, frame: int, payload: Any, path: str) -> Received:
    """A message that is well-formed and, where its sender signs, signed.

    Raises
    ------
    WireError, Unusable
    """
    role: Role = "ego" if vehicle == caller.record.ego_id else "teammate"
    message = wire.check_message(payload, caller.live.detector.info, role, path)
    signature = wire.read_signature(payload, path)
    truth = read_truth(payload, path) if role == "ego" else None
    key = caller.record.public_keys.get(vehicle)
    received = Received(message, wire.content_digest(frame, vehicle, message), signature, key, truth)
    if key is not None:
        field_ = f"{path}.signature" if path else "signature"
        if signature is None:
            raise Unusable(Kind.BAD_SIGNATURE, Reason.UNAUTHENTICATED, f"messages of {vehicle} must be signed", field_)
        if not is_valid(read_public_key(key), caller.record.session_id, vehicle, frame, received.digest, signature):
            detail = f"not the signature of {vehicle} over this message for this session"
            raise Unusable(Kind.BAD_SIGNATURE, Reason.UNAUTHENTICATED, detail, field_)
    return received
