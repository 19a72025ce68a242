"""What is answered about a frame: the one form that the gateway sends, the client reads and the audit log keeps.

Nothing here computes anything. It needs neither torch nor scipy, so that a client can read answers without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from robosac.boxes import FloatArray, pose_fault, to_world


class Verdict(StrEnum):
    """What a comparison of two perceptions says about the hypothesis behind one of them."""

    CONSENSUS = "consensus"
    DISSENSUS = "dissensus"
    NO_EVIDENCE = "no_evidence"
    """Both perceptions are empty: they agree on nothing, which speaks neither for nor against anybody."""


class Source(StrEnum):
    """Where the boxes of an answer come from."""

    CONSENSUS = "consensus"
    TRUSTED = "trusted"
    EGO_ONLY = "ego_only"


class Reason(StrEnum):
    """Why a teammate was left out of an answer.

    ``not_sampled`` also stands where a teammate was in tested hypotheses but no verdict was reached, because ego and
    fusion were both empty, or where only consensus was, and the answer is of others. ``suspected``: no test of the
    frame speaks against it, but the defence takes it more likely than not for an attacker. For ``distrusted``,
    `Distrust` says why.
    """

    DISSENSUS = "dissensus"
    NOT_SAMPLED = "not_sampled"
    SUSPECTED = "suspected"
    DISTRUSTED = "distrusted"
    MISSING = "missing"
    LATE = "late"
    MALFORMED = "malformed"
    STALE = "stale"
    UNAUTHENTICATED = "unauthenticated"
    REPLAYED = "replayed"
    IMPLAUSIBLE = "implausible"
    REPEATED = "repeated"
    COPIED = "copied"


class Distrust(StrEnum):
    """Why a teammate is distrusted."""

    NAMED = "named"
    """The defence names it as an attacker."""
    UNTRUSTED = "untrusted"
    """It is not on the trust list from which the frame was answered."""
    EQUIVOCATION = "equivocation"
    """It sent different messages for the frame."""


class Standing(StrEnum):
    """How a box stands among those who could see the place."""

    CONFIRMED = "confirmed"
    """The ego sees it and is not outweighed, or two teammates do and nobody denies it."""
    SINGLE_WITNESS = "single_witness"
    """Nobody denies it, and fewer than two teammates are sure of it, as where nobody else can see: no accusation."""
    DISPUTED = "disputed"
    """Somebody who could have seen it did not, but not so many of them that it is left out."""
    REPAIRED = "repaired"
    """It is taken from a fusion without a teammate whose joining removes or moves it."""
    CONTRADICTED = "contradicted"
    """The ego, three teammates, or two and the ego inclined to agree, could have seen it and did not; or nobody saw it
    of which the fusion is sure.
    """


def _array_of(*shape: int) -> Any:
    """A validator of nested lists of numbers that makes a float64 array of a shape."""

    def check(value: Any) -> FloatArray:
        try:
            array = np.asarray(value)
            if array.size and array.dtype.kind not in "iuf":
                raise ValueError(array.dtype)
            return array.astype(np.float64).reshape(shape)
        except (TypeError, ValueError) as error:
            raise ValueError(f"must be numbers of shape {shape}") from error

    return PlainValidator(check)


_AS_LISTS = PlainSerializer(lambda array: array.tolist(), return_type=list)
_NUMBER = {"type": "number"}
Boxes = Annotated[
    FloatArray,
    _array_of(-1, 6),
    _AS_LISTS,
    WithJsonSchema({"type": "array", "items": {"type": "array", "items": _NUMBER, "minItems": 6, "maxItems": 6}}),
]
"""(n, 6) float64; nested lists in JSON."""
Pose = Annotated[
    FloatArray,
    _array_of(4, 4),
    PlainSerializer(lambda array: array.reshape(-1).tolist(), return_type=list),
    WithJsonSchema({"type": "array", "items": _NUMBER, "minItems": 16, "maxItems": 16}),
]
"""(4, 4) float64 world_from_sensor; 16 numbers in JSON, row-major."""


class Typed(BaseModel):
    """A part of an answer or a record. Fields that a later version adds are read past."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, ser_json_inf_nan="constants")

    def as_json(self) -> dict[str, Any]:
        """JSON values; `model_validate` reads them back."""
        return self.model_dump(mode="json")

    def __getitem__(self, name: str) -> Any:
        """A field by its name in JSON, such as evidence, whose names depend on the reason."""
        try:
            return getattr(self, name)
        except AttributeError as error:
            raise KeyError(name) from error


class TestedHypothesis(Typed):
    """One tested subset."""

    __test__ = False  # no test of pytest's, whatever its name

    teammates: tuple[str, ...]
    jaccard_index: float
    verdict: Verdict


class Support(Typed):
    """On whose word a box stands. Ids are of vehicles, the ego's among them."""

    status: Standing
    witnesses: tuple[str, ...] = Field(description="Whose messages show a vehicle there.")
    deniers: tuple[str, ...] = Field(description="Who could have seen a vehicle there, and shows none.")


class ContradictedBox(Support):
    """A box that is left out of the answer, as it was decoded."""

    box: tuple[float, float, float, float, float, float] = Field(
        description="x, y, length, width, yaw, score; ego frame, metres and radians"
    )


class Likeness(Typed):
    """Two maps that are more alike than those of honest vehicles in traffic; it accuses neither.

    ``other`` sent its map in the frame ``of_frame``; it may be the same vehicle, in another place.
    """

    vehicle: str
    other: str
    of_frame: int
    correlation: float


class RejectedTeammate(Typed):
    """Why an enrolled teammate is not in the answer; evidence follows as further fields."""

    model_config = ConfigDict(extra="allow")

    vehicle_id: str
    reason: Reason
    distrust: Distrust | None = Field(
        None,
        exclude_if=lambda value: value is None,
        description="That it is named, or why else it is distrusted.",
    )


def _by_vehicle(value: Any) -> dict[str, RejectedTeammate]:
    entries = value.values() if isinstance(value, Mapping) else value
    if not isinstance(value, Mapping | list | tuple):
        raise ValueError("must be a list")
    rejected = map(RejectedTeammate.model_validate, entries)
    return {entry.vehicle_id: entry for entry in rejected}


class LogReceipt(Typed):
    """The gateway's promise that its log of a session begins with these records, signed.

    See `robosac.signatures.is_valid_head`.
    """

    session: str
    seq: int = Field(description="Number of the log's latest record.")
    head: str = Field(description="SHA-256 of that record.")
    key_id: str = Field(description="Which of the gateway's keys signed, see /v1/keys.")
    signature: str = Field(description="Ed25519, base64.")


class FrameAnswer(Typed):
    """The answer to one frame.

    In Python ``boxes`` is an (n, 6) float64 ndarray and ``rejected`` a mapping by vehicle id.
    """

    frame: int
    boxes: Boxes = Field(description="x, y, length, width, yaw, score; ego frame, metres and radians, best first")
    support: tuple[Support, ...] | None = Field(
        None, description="On whose word each box stands, parallel to the boxes, where the defence knows it."
    )
    contradicted: tuple[ContradictedBox, ...] | None = Field(
        None, description="Boxes that are contradicted and left out, best first, where the defence knows them."
    )
    source: Source
    accepted: tuple[str, ...]
    rejected: Annotated[
        Mapping[str, RejectedTeammate],
        PlainValidator(_by_vehicle, json_schema_input_type=list[RejectedTeammate]),
        PlainSerializer(lambda rejected: list(rejected.values()), return_type=list[RejectedTeammate]),
    ]
    hypotheses: tuple[TestedHypothesis, ...]
    sampling_steps: int
    attacker_ratio: float | None
    suspicion: dict[str, float] | None = Field(
        None, description="Probability that each teammate attacks, where the defence knows it."
    )
    alike: tuple[Likeness, ...] = Field(
        (), exclude_if=lambda value: not value, description="Maps that are strangely alike, most alike first."
    )
    unread: tuple[str, ...] = Field(
        (), exclude_if=lambda value: not value, description="Teammates whose testimony there was no time to read."
    )
    deadline_met: bool
    degraded_by: Literal["deadline", "fault"] | None = Field(description="What cut the defence short, if anything.")
    timings_ms: dict[str, float]
    receipt: LogReceipt | None = Field(
        None, exclude_if=lambda value: value is None, description="The log's end once this is on record, signed."
    )

    @field_validator("support")
    @classmethod
    def _check_parallel(cls, support: tuple[Support, ...] | None, others: ValidationInfo) -> tuple[Support, ...] | None:
        boxes = others.data.get("boxes")
        if support is not None and boxes is not None and len(support) != len(boxes):
            raise ValueError(f"must be parallel to the boxes: {len(support)} for {len(boxes)}")
        return support

    def boxes_in_world(self, pose: FloatArray) -> FloatArray:
        """The boxes (n, 6) in the world's frame.

        Parameters
        ----------
        pose : (4, 4) ndarray
            world_from_sensor of the ego, as it sent it with the frame.

        Raises
        ------
        ValueError
            If that is no pose.
        """
        return _in_world(self.boxes, pose)

    def contradicted_in_world(self, pose: FloatArray) -> FloatArray:
        """Boxes (n, 6) that were left out as contradicted, as `boxes_in_world` gives the others; often none."""
        return _in_world(np.array([out.box for out in self.contradicted or ()]).reshape(-1, 6), pose)

    @property
    def named(self) -> tuple[str, ...]:
        """Teammates that the defence names as attackers."""
        return tuple(name for name, entry in self.rejected.items() if entry.distrust is Distrust.NAMED)


def _in_world(boxes: FloatArray, pose: FloatArray) -> FloatArray:
    matrix = np.asarray(pose, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"a pose must be 4 x 4 finite numbers, got shape {matrix.shape}")
    if fault := pose_fault(matrix):
        raise ValueError(f"a pose {fault}")
    return to_world(boxes, matrix)
