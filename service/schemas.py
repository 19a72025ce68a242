"""The JSON of the API, checked at the edge."""

from __future__ import annotations

from collections.abc import Collection
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapSerializer,
    WrapValidator,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from robosac.answers import LogReceipt
from robosac.calibrated import calibration_digest, calibration_of
from robosac.defenses import DefenseSettings, Kinds, check_kinds, check_numbers, shipped
from robosac.defenses.group_testing import CalibrationError
from robosac.detectors import DetectorInfo
from robosac.signatures import read_public_key
from robosac.wire import ID_PATTERN

MAX_KEYS = 1025
VehicleId = Annotated[str, StringConstraints(pattern=ID_PATTERN)]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _check_kinds(cls, values: object) -> object:
        return check_kinds(cls, values)

    @field_validator("*")
    @classmethod
    def _check_numbers(cls, value: object) -> object:
        return check_numbers(value)


def _as_served(value: object, of_shipped: ValidatorFunctionWrapHandler, about: ValidationInfo) -> object:
    """Read the settings of a defence that ships, or of another one that is served: these are the context."""
    if isinstance(value, DefenseSettings):
        return value
    if not isinstance(value, dict):
        return of_shipped(value)
    kinds: Kinds = about.context or shipped()
    kind = value.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        unknown = PydanticCustomError("unknown_kind", "must be one of {kinds}", {"kinds": ", ".join(kinds)})
        raise ValidationError.from_exception_data("defense", [{"type": unknown, "loc": ("kind",), "input": kind}])
    return of_shipped(value) if kind in shipped() else kinds[kind].model_validate(value)


if TYPE_CHECKING:
    ChosenDefense = DefenseSettings
else:
    ChosenDefense = Annotated[
        reduce(or_, shipped().values()),
        Field(discriminator="kind"),
        WrapValidator(_as_served),
        WrapSerializer(lambda settings, _: settings.model_dump(mode="json")),
    ]
    """Settings of any defence that is served; described as one of those that ship."""


def _check_distinct(teammates: list[str]) -> list[str]:
    if len(set(teammates)) != len(teammates):
        raise ValueError("teammates must be distinct")
    return teammates


def _check_key(key: str) -> str:
    read_public_key(key)
    return key


def _check_number(keys: object) -> object:
    if isinstance(keys, dict) and len(keys) > MAX_KEYS:  # else each of too many would be looked at first
        raise ValueError(f"at most {MAX_KEYS} keys are allowed")
    return keys


PublicKeys = Annotated[
    dict[VehicleId, Annotated[str, AfterValidator(_check_key)]],
    BeforeValidator(_check_number),
    Field(
        max_length=MAX_KEYS, description="Ed25519 public keys, base64, of those vehicles that sign all their messages."
    ),
]


def _check_signers(keys: dict[str, str], vehicles: Collection[str]) -> None:
    strangers = sorted(set(keys) - set(vehicles))
    if strangers:
        raise ValueError(f"{strangers[0]} is not among the vehicles")


class EnrolmentRequest(_Request):
    """Teammates that join a session."""

    teammates: Annotated[list[VehicleId], AfterValidator(_check_distinct)] = Field(
        min_length=1, max_length=1024, fail_fast=True
    )
    public_keys: PublicKeys = {}

    @field_validator("public_keys")
    @classmethod
    def _keys_of_newcomers(cls, keys: dict[str, str], others: ValidationInfo) -> dict[str, str]:
        _check_signers(keys, others.data.get("teammates", keys))
        return keys


class SessionRequest(_Request):
    """Opens a session of one ego with its teammates."""

    ego_id: VehicleId
    teammates: list[VehicleId] = Field(max_length=1024, fail_fast=True)
    detector: str | None = None
    defense: ChosenDefense | None = Field(
        None, description="By default group_testing where the detector is calibrated for it, else sample_consensus."
    )
    latency_budget_ms: float | None = Field(None, gt=0, le=60_000)
    gather_ms: float | None = Field(None, ge=0, le=60_000, description="At most the latency budget.")
    public_keys: PublicKeys = {}
    frame_period_ms: float = Field(200.0, gt=0, le=60_000, description="Time between two frames, to judge motion by.")
    record: bool = Field(False, description="Asks for a recording, where the gateway makes them.")

    @field_validator("teammates")
    @classmethod
    def _distinct_vehicles(cls, teammates: list[str], others: ValidationInfo) -> list[str]:
        _check_distinct(teammates)
        if others.data.get("ego_id") in teammates:
            raise ValueError("the ego cannot be its own teammate")
        return teammates

    @field_validator("public_keys")
    @classmethod
    def _keys_of_vehicles(cls, keys: dict[str, str], others: ValidationInfo) -> dict[str, str]:
        if {"ego_id", "teammates"} <= set(others.data):
            _check_signers(keys, [others.data["ego_id"], *others.data["teammates"]])
        return keys


class _Shown(BaseModel):
    """Read from the object that is shown; what is not declared here is not shown."""

    model_config = ConfigDict(from_attributes=True)


class TensorEntry(_Shown):
    """Type and shape of one tensor."""

    dtype: str
    shape: list[int]


class CalibrationEntry(BaseModel):
    """What a detector is calibrated for, as the defence `group_testing` needs it."""

    kinds: list[str] = Field(description="attacks that it was observed under")
    pose_errors_m: list[float] = Field(description="errors of the teammates' positions that it was observed with")
    digest: str = Field(description="SHA-256 of the calibration and the witness together")
    objects_judged: bool = Field(description="whether it has a witness, so that single objects are judged")

    @classmethod
    def of(cls, info: DetectorInfo) -> CalibrationEntry | None:
        """The entry; None if the detector has no calibration, or one that cannot be used."""
        try:
            calibration = calibration_of(info)
        except CalibrationError:
            return None
        return cls(
            kinds=list(calibration.levels[0].kinds),
            pose_errors_m=[level.pose_error_m for level in calibration.levels],
            digest=calibration_digest(info) or "",
            objects_judged=calibration.witnessed,
        )


class DetectorEntry(_Shown):
    """What a detector wants to be sent."""

    name: str
    tensors: dict[Literal["ego", "teammate"], dict[str, TensorEntry]]
    narrower: dict[str, list[str]] = Field(description="by tensor, other types that it may be sent in")
    area_m: tuple[float, float, float, float] = Field(description="xmin, ymin, xmax, ymax; ego frame, metres")
    cell_m: float
    weights_digest: str = Field(description="SHA-256 of the weights file")
    precision: str = Field(description="numbers in which fused maps are decoded")
    device: str = Field(description="where it computes, by torch's name")
    consensus_score: float = Field(description="boxes from this score on take part in the consensus test")
    calibration: CalibrationEntry | None

    @model_validator(mode="before")
    @classmethod
    def _with_calibration(cls, shown: object) -> object:
        """A detector says only where the file of its calibration is."""
        if not isinstance(shown, DetectorInfo):
            return shown
        return {**vars(shown), "narrower": shown.narrower, "calibration": CalibrationEntry.of(shown)}


class DetectorList(BaseModel):
    """All detectors of this gateway."""

    detectors: list[DetectorEntry]


class SessionCreated(BaseModel):
    """A new session and the tokens of its vehicles; they are shown only here."""

    session_id: str
    ego_token: str
    teammate_tokens: dict[str, str]
    tokens_expire_at: str
    detector: DetectorEntry
    defense: ChosenDefense
    latency_budget_ms: float
    gather_ms: float
    frame_period_ms: float
    receipt: LogReceipt = Field(description="The log's beginning, signed by the gateway.")
    recorded: bool = Field(False, description="Whether the gateway records the session.")


class GatewayKey(BaseModel):
    """One of the gateway's public keys."""

    key_id: str
    public_key: str = Field(description="Ed25519, 32 bytes in base64.")
    signs: bool = Field(description="Whether it signs now; what the others signed before is still good.")


class GatewayKeyList(BaseModel):
    """The gateway's public keys."""

    keys: list[GatewayKey]


class ChangedTeam(BaseModel):
    """The team after some joined, and the tokens of those; they are shown only here."""

    teammates: list[str]
    teammate_tokens: dict[str, str]
    tokens_expire_at: str
    receipt: LogReceipt = Field(description="The log's end at this moment, signed by the gateway.")


class RenewedToken(BaseModel):
    """A vehicle's fresh token; it is shown only here."""

    token: str
    expires_at: str
    receipt: LogReceipt = Field(description="The log's end at this moment, signed by the gateway.")


class SessionState(BaseModel):
    """A session as its ego sees it."""

    session_id: str
    ego_id: str
    teammates: list[str]
    detector: str
    defense: ChosenDefense
    latency_budget_ms: float
    gather_ms: float
    frame_period_ms: float
    created_at: str
    last_frame: int | None
    frames_answered: int
    state: dict[str, Any] = Field(description="What the defence remembers between frames.")
    suspicion: dict[str, float] | None = Field(
        None, description="Probability that each teammate attacks, where the defence knows it."
    )
    audit_seq: int = Field(description="Number of the latest audit record.")
    audit_head: str = Field(description="SHA-256 of the latest audit record: with it a cut-off log is found out.")
    receipt: LogReceipt = Field(description="The same end of the log, signed by the gateway.")
    next_seed_commitment: str = Field(description="SHA-256 of the seed of the next frame's draws.")


class Receipt(BaseModel):
    """A teammate's message is kept for its frame."""

    frame: int
    vehicle_id: str
    status: Literal["accepted"] = "accepted"
    receipt: LogReceipt = Field(description="The log's end at this moment, signed by the gateway.")


class WatchableSession(BaseModel):
    """A session whose latest frames can be watched."""

    session_id: str
    ego_id: str
    teammates: list[str]
    detector: str
    defense: str
    created_at: str
    latency_budget_ms: float
    least_score: float = Field(description="Boxes from this score on take part in the consensus test.")
    frames: int = Field(description="Answered so far.")
    frame: int = Field(description="Number of the latest.")
    answered_at: float = Field(description="When, Unix seconds.")
    named: list[str] = Field(description="Teammates held to be attackers.")
    viewers: int


class WatchableList(BaseModel):
    """Sessions whose latest frames can be watched, the one that was answered last first."""

    sessions: list[WatchableSession]
