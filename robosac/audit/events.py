"""Every kind of audit record as a type, with one way to JSON and back.

A record on a line holds, besides its event's fields, ``session_id``, ``seq`` and ``previous`` (`robosac.audit.chain`).
Lines are read strictly: a number is no text, and nothing is filled in but what older versions did not write.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import to_json

from robosac.answers import FrameAnswer, Pose, Reason, Typed
from robosac.audit.expanding import FORMAT, expanded, unpacked
from robosac.audit.lines import RecordError, read
from robosac.defenses import trusted_in


def now() -> str:
    """The time as RFC 3339, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _is_time(text: str) -> bool:
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return False


def _decoded(value: Any) -> Any:
    return base64.b64decode(value, validate=True) if isinstance(value, str) else value


Count = Annotated[int, Field(ge=0)]
Frames = tuple[Count, ...]
Milliseconds = Annotated[float, Field(ge=0, le=86_400_000)]
"""Nothing that a gateway waits for or measures takes more than a day."""


_SEED_DIGITS = 1024
"""Of a seed, hexadecimal. A gateway's has 64; to draw from one of a megabyte takes long."""


class Proof(Typed):
    """Who said what: the digest of a message (`robosac.wire.content_digest`), and its signature where it has one."""

    digest: str
    signature: Annotated[
        bytes | None,
        BeforeValidator(_decoded),
        PlainSerializer(lambda raw: base64.b64encode(raw).decode(), return_type=str),
    ] = Field(None, exclude_if=lambda raw: raw is None)


class _Event(Typed):
    """What all events have."""

    time: str = Field(default_factory=now)

    @field_validator("time")
    @classmethod
    def _check_time(cls, time: str) -> str:
        if not time.endswith("Z") or not _is_time(time):
            raise ValueError("must be a time in UTC, as RFC 3339 writes it")
        return time


def _check_state(state: dict[str, Any]) -> dict[str, Any]:
    trusted_in(state)
    return state


State = Annotated[dict[str, Any], AfterValidator(_check_state)]
"""A defence's, JSON values."""


class MessageBounds(Typed):
    """What honest messages hold of a tensor, as `robosac.screening.Bounds` has it."""

    largest: float
    rms: float
    still: float


class SessionOpened(_Event):
    """A session begins: with whom, which detector, which settings."""

    event: Literal["session_opened"] = "session_opened"
    version: str
    ego_id: str
    teammates: tuple[str, ...]
    detector: str
    weights_digest: str
    calibration_digest: str | None = None
    defense: dict[str, Any]
    screening: dict[str, MessageBounds] | None = None
    """By tensor: what honest messages hold; None where messages are not tested before they are fused."""
    latency_budget_ms: Milliseconds
    gather_ms: Milliseconds
    frame_period_ms: Milliseconds
    public_keys: dict[str, str]
    state: State
    next_seed_commitment: str


class TeamChanged(_Event):
    """Teammates joined or left."""

    event: Literal["team_changed"] = "team_changed"
    joined: tuple[str, ...]
    left: tuple[str, ...]
    teammates: tuple[str, ...]
    public_keys: dict[str, str]
    state: State


class DetectorChanged(_Event):
    """The gateway was started again with other weights, or another calibration, of the detector's name.

    Where the operator did not allow that the session goes on with them, ``accepted`` is false, and it stands still.
    """

    event: Literal["detector_changed"] = "detector_changed"
    detector: str
    weights_digest: str
    calibration_digest: str | None = None
    screening: dict[str, MessageBounds] | None = None
    accepted: bool


class FrameAnswered(_Event, FrameAnswer):
    """A frame is decided: the answer, and all that it takes to recompute it.

    ``seed`` is that of the frame's draws, committed to in an earlier record. ``messages`` are those in the frame, the
    ego's among them. ``previous_frame`` is the frame of the previous answer that the fusion was given. Refusals that
    were too many to get a record each are counted in ``unlogged_refusals``, by vehicle; ``?`` stands for callers
    without a valid token. ``late`` are frames before this one whose records say that they were in time, which was known
    when they were written, and whose answers were late after all.

    A record that is not full has no ``state``, but its ``state_digest`` (`robosac.audit.packing.state_digest`) and whom
    it trusts. ``gateway`` names the process that decided; older logs do not.
    """

    event: Literal["frame_answered"] = "frame_answered"
    frame: Count
    timings_ms: dict[str, Milliseconds]
    seed: str = Field(max_length=_SEED_DIGITS)
    ego_pose: Pose
    messages: dict[str, Proof]
    previous_frame: Count | None = None
    out_of_time: bool
    fault: str | None = None
    state: State | None = Field(None, exclude_if=lambda state: state is None)
    state_digest: str | None = Field(None, exclude_if=lambda digest: digest is None)
    trusted: tuple[str, ...] | None = Field(None, exclude_if=lambda names: names is None)
    unlogged_refusals: dict[str, Count] = Field(default_factory=dict)
    late: Frames = Field((), exclude_if=lambda frames: not frames)
    next_seed_commitment: str
    gateway: str = Field("", exclude_if=lambda name: not name)

    @field_validator("seed")
    @classmethod
    def _check_seed(cls, seed: str) -> str:
        int(seed, 16)
        bytes.fromhex(seed)
        return seed

    @model_validator(mode="after")
    def _check_state_is_known(self) -> Self:
        if self.state is None and (self.state_digest is None or self.trusted is None):
            raise ValueError("a record without state needs state_digest and trusted")
        return self

    @property
    def trusts(self) -> tuple[str, ...]:
        """The trust list after the frame."""
        return trusted_in(self.state) if self.state is not None else self.trusted or ()


class MessageRefused(_Event):
    """A message was not accepted; ``vehicle_id`` is whose token sent it, whatever the message claims."""

    event: Literal["message_refused"] = "message_refused"
    vehicle_id: str
    frame: int | None = None
    reason: Reason
    detail: str
    field: str | None = None


class AccessRefused(_Event):
    """Somebody came without a valid token; ``vehicle_id`` is whose it was, None if it was nobody's."""

    event: Literal["access_refused"] = "access_refused"
    vehicle_id: str | None
    reason: Literal[Reason.UNAUTHENTICATED] = Reason.UNAUTHENTICATED
    detail: str


class TokenRenewed(_Event):
    """A vehicle took a fresh token; the one before is worth nothing any more."""

    event: Literal["token_renewed"] = "token_renewed"
    vehicle_id: str
    expires_at: str


class Equivocation(_Event):
    """A vehicle sent two different messages for one frame. The ego's first is signed in its frame's record."""

    event: Literal["equivocation"] = "equivocation"
    vehicle_id: str
    frame: Count
    first: Proof
    second: Proof


class SessionEnded(_Event):
    """A session was closed by its ego, or expired; ``late`` as of `FrameAnswered`."""

    event: Literal["session_ended"] = "session_ended"
    why: str
    late: Frames = Field((), exclude_if=lambda frames: not frames)


Event = (
    SessionOpened
    | TeamChanged
    | DetectorChanged
    | FrameAnswered
    | MessageRefused
    | AccessRefused
    | TokenRenewed
    | Equivocation
    | SessionEnded
)
_PACKED = ("boxes", "support")
_KINDS: Mapping[str, type[Event]] = {kind.model_fields["event"].default: kind for kind in get_args(Event)}


def event_on(line: bytes) -> Event | None:
    """The event on a line, its line break taken off; None for a kind that this version does not know.

    Raises
    ------
    RecordError
        If it is not a JSON object, or not what an event of its kind has to be.
    """
    return event_of(read(line))


def event_of(record: Mapping[str, Any]) -> Event | None:
    """As `event_on`, of a record that was read already."""
    name = record.get("event")
    if not isinstance(name, str):
        raise RecordError("event: must be a string")
    kind = _KINDS.get(name)
    if kind is None:
        return None
    try:
        if kind is FrameAnswered and _is_packed(record):
            return _read_packed(record)
        return kind.model_validate_json(to_json(expanded(record)), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise RecordError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    except (ValueError, RecursionError) as error:
        raise RecordError(str(error)) from error


def _is_packed(record: Mapping[str, Any]) -> bool:
    boxes, support = record.get("boxes"), record.get("support")
    is_text = isinstance(boxes, str) and isinstance(support, str | None)
    return is_text and record.get("format") == FORMAT and isinstance(record.get("messages"), dict)


def _read_packed(record: Mapping[str, Any]) -> FrameAnswered:
    """A decision whose boxes need not be made JSON and be read again, which would take most of the time."""
    boxes, support = unpacked(record)
    rest = {**expanded(record, _PACKED), "boxes": (), "support": None}
    answer = FrameAnswered.model_validate_json(to_json(rest), strict=True)
    if support is not None and len(support) != len(boxes):
        raise RecordError(f"support: must be parallel to the boxes: {len(support)} for {len(boxes)}")
    return answer.model_copy(update={"boxes": boxes, "support": support})
