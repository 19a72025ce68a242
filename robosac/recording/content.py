"""What a recording holds: its channels, and the form of what is on each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

from pydantic import AfterValidator, Field

from robosac.answers import FrameAnswer, Pose, Typed
from robosac.defenses import State
from robosac.detectors import Message
from robosac.previous import PreviousAnswer
from robosac.recording.truth import Truth

METADATA = "robosac"
FORMAT = "1"
"""In the metadata of each file; a later version that older readers misread has another one."""
SESSION, MESSAGES, DIGESTS, POSES, TRUTH, ANSWERS, FRAMES = (
    "/session", "/messages", "/digests", "/poses", "/truth", "/answers", "/frames",
)  # fmt: skip


def _of_a_kind(defense: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(defense.get("kind"), str):
        raise ValueError("kind must be a string")
    return defense


class Opening(Typed):
    """The session that a file is of; each file begins with it."""

    session_id: str
    ego_id: str
    teammates: tuple[str, ...] = Field(description="When the file began.")
    detector: str
    weights_digest: str | None
    calibration_digest: str | None
    defense: Annotated[dict[str, Any], AfterValidator(_of_a_kind)] = Field(
        description="Settings, as the API gives them."
    )
    least_score: float = Field(description="Boxes from this score on took part in the consensus test.")
    latency_budget_ms: float
    frame_period_ms: float = Field(gt=0, allow_inf_nan=False)
    created_at: str = Field(description="When the session was opened, RFC 3339, UTC.")
    version: str = Field(description="Of the gateway.")
    bodies: bool = Field(description="Whether messages are recorded; else only their digests.")
    part: int = Field(description="Number of the file among those of the session, from 1 on.")


class Poses(Typed):
    """Where the vehicles said that they were."""

    frame: int
    poses: dict[str, Pose] = Field(description="By vehicle: world_from_sensor, 4 x 4, row-major, metres.")


class Digest(Typed):
    """A message of which only that is kept which proves what it was."""

    frame: int
    vehicle_id: str
    digest: str = Field(description="SHA-256 of what the message says (robosac.wire.content_digest).")
    signature: str | None = Field(None, description="Of the sender, hexadecimal.")


class TrueFrame(Typed):
    """What the ego's sender says is true."""

    frame: int
    boxes: list[Annotated[list[float], Field(min_length=5, max_length=5)]] = Field(
        description="x, y, length, width, yaw; ego frame, metres and radians"
    )
    attackers: tuple[str, ...]


class Before(Typed):
    """What the session remembered before a frame."""

    state: dict[str, Any]
    previous: dict[str, Any] | None = Field(description="The latest answer, as the next may be compared with it.")


class Decided(Typed):
    """All else that it takes to make a decision again. The last that is written of a frame."""

    frame: int
    team: tuple[str, ...] = Field(description="Enrolled teammates.")
    fused: tuple[str, ...] = Field(description="Teammates whose messages took part.")
    seed: str = Field(description="Of the draws, hexadecimal.", pattern="^[0-9a-f]+$")
    before: Before | None = Field(
        None, description="Where it is not what the frame before in the file left, or there is none."
    )
    out_of_time: bool = Field(description="Whether the defence was cut short.")
    dropped: int = Field(0, description="Frames of the session before this one that are not in the recording.")


class Said(Protocol):
    """A message that was checked, and what proves who said it."""

    @property
    def message(self) -> Message: ...

    @property
    def digest(self) -> str: ...

    @property
    def signature(self) -> bytes | None: ...

    @property
    def at(self) -> float: ...


@dataclass(frozen=True)
class Moment:
    """A frame to be recorded. Nothing of it is copied, and nothing changes it any more."""

    time_ns: int
    """When it was answered, Unix nanoseconds."""
    messages: Mapping[str, Said]
    """By vehicle, the ego's first; those of teammates that did not take part, too."""
    fused: tuple[str, ...]
    team: tuple[str, ...]
    seed: str
    answer: FrameAnswer
    state: State
    """What was remembered before it."""
    previous: PreviousAnswer | None
    left: State
    """And after it."""
    left_previous: PreviousAnswer | None
    least_score: float
    """The detector's consensus score."""
    out_of_time: bool = False
    truth: Truth | None = None


_POSE = {"type": "array", "items": {"type": "number"}, "minItems": 16, "maxItems": 16}
_TENSOR = {
    "type": "object",
    "properties": {
        "dtype": {"type": "string"},
        "shape": {"type": "array", "items": {"type": "integer"}},
        "data": {"type": "string", "contentEncoding": "binary", "description": "little-endian, C order"},
    },
}
_MESSAGE = {
    "title": "Message",
    "description": "A vehicle's own message as it is on the wire: a map in msgpack, of which this is the shape.",
    "type": "object",
    "properties": {
        "frame": {"type": "integer"},
        "vehicle_id": {"type": "string"},
        "pose": {**_POSE, "description": "world_from_sensor, row-major, metres"},
        "tensors": {"type": "object", "additionalProperties": _TENSOR},
        "signature": {"type": "string", "contentEncoding": "binary"},
    },
    "required": ["frame", "vehicle_id", "pose", "tensors"],
}


@dataclass(frozen=True)
class Form:
    """How what is on a channel is written."""

    name: str
    """Of the schema."""
    encoding: str
    """Of the messages, as MCAP names it."""
    schema: str
    """JSON Schema."""


def _form(kind: type[Typed]) -> Form:
    return Form(f"robosac.{kind.__name__}", "json", json.dumps(kind.model_json_schema(mode="serialization")))


FORMS: Mapping[str, Form] = {
    SESSION: _form(Opening),
    MESSAGES: Form("robosac.Message", "msgpack", json.dumps(_MESSAGE)),
    DIGESTS: _form(Digest),
    POSES: _form(Poses),
    TRUTH: _form(TrueFrame),
    ANSWERS: _form(FrameAnswer),
    FRAMES: _form(Decided),
}
"""By topic; those of ROS 2 are in `robosac.interfaces.ros2`."""
