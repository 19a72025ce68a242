"""The JSON of the API, checked at the edge."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    TypeAdapter,
    ValidationInfo,
    field_validator,
)

from robosac.budget import DEFAULT_CONFIDENCE
from robosac.calibration import calibration_of
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses import Defense, Reference, build
from robosac.defenses.a2cp import DEFAULT_BUDGET as DEFAULT_A2CP_BUDGET
from robosac.defenses.conformal import DEFAULT_RATE
from robosac.defenses.group_testing import DEFAULT_HAZARDS
from robosac.defenses.group_testing.defense import (
    DEFAULT_FIRST_BUDGET,
    DEFAULT_LATER_BUDGET,
    DEFAULT_NAMING_BOUND,
    DEFAULT_POSE_ERROR_M,
)
from robosac.defenses.static_team import DEFAULT_RECHECK
from robosac.detectors import DetectorInfo
from robosac.signatures import read_public_key

COMPARABLE_PERIOD_MS = 250.0
"""Longest period of frames of which one is like the next, as calibrated at 200 ms."""
MAX_KEYS = 1025
VehicleId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,63}$")]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _DefenseSettings(_Request):
    def build(self, detector: DetectorInfo) -> Defense:
        """The defence itself, for a detector.

        Raises
        ------
        robosac.budget.DomainError
            If the settings contradict each other, or the detector lacks the calibration that the defence needs.
        """
        return build(self.model_dump(mode="json"), lambda: calibration_of(detector))

    def at_period(self, frame_period_ms: float) -> Self:  # noqa: ARG002
        """With what is left open decided for frames so far apart."""
        return self


class _SamplingSettings(_DefenseSettings):
    attacker_ratio: float = Field(0.2, gt=0, lt=1, description="Assumed share of attackers among the teammates.")
    sampling_budget: int | None = Field(None, ge=1, le=10_000, description="Most hypotheses tested in a frame.")
    collaborators: int | None = Field(None, ge=1, le=1024, description="Teammates in a hypothesis.")
    confidence: float = Field(DEFAULT_CONFIDENCE, gt=0, lt=1)
    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    reference: Reference = Field(Reference.EGO, description="What a hypothesis is compared with.")


class SampleConsensusSettings(_SamplingSettings):
    """ROBOSAC, Algorithm 1: sample subsets of teammates until one agrees with the reference."""

    kind: Literal["sample_consensus"] = "sample_consensus"


class StaticTeamSettings(_SamplingSettings):
    """Find trustworthy teammates once, rely on them, and look again now and then."""

    kind: Literal["static_team"]
    recheck_every: int | None = Field(
        DEFAULT_RECHECK, ge=1, description="Frames between two re-checks of the trusted; null never looks again."
    )


class A2CPSettings(_DefenseSettings):
    """Aggressive-to-conservative probing: estimate the attacker ratio while answering."""

    kind: Literal["a2cp"]
    ratios: tuple[float, ...] | None = Field(
        None, min_length=1, max_length=64, description="Ascending in [0, 1); by default all that the team size allows."
    )
    sampling_budget: int = Field(DEFAULT_A2CP_BUDGET, ge=1, le=10_000, description="Most hypotheses tested in a frame.")
    confidence: float = Field(DEFAULT_CONFIDENCE, gt=0, lt=1)
    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    reference: Reference = Field(Reference.EGO, description="What a hypothesis is compared with.")


class _MemorylessSettings(_DefenseSettings):
    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    reference: Reference = Field(Reference.EGO, description="What a hypothesis is compared with.")


class HalvingSettings(_MemorylessSettings):
    """Split the team until every group agrees with the reference or is a single teammate."""

    kind: Literal["halving"]


class OneByOneSettings(_MemorylessSettings):
    """Test every teammate alone, then all that passed together."""

    kind: Literal["one_by_one"]


class ConformalSettings(_MemorylessSettings):
    """Calibrated tests of every teammate with control of false discoveries."""

    kind: Literal["conformal"]
    false_discovery_rate: float = Field(
        DEFAULT_RATE, gt=0, lt=1, description="Expected share of honest teammates among the accused, at most."
    )
    calibration: tuple[Annotated[float, Field(ge=0, le=1)], ...] | None = Field(
        None,
        min_length=1,
        max_length=10_000,
        description="Jaccard indices of honest single teammates; by default those of the shipped detector.",
    )


class UndefendedSettings(_DefenseSettings):
    """No defence: everybody is fused and nothing is tested. A baseline."""

    kind: Literal["none"]


class GroupTestingSettings(_DefenseSettings):
    """Bayesian group testing with memory: finds attackers of an unknown number, and names them."""

    kind: Literal["group_testing"] = "group_testing"
    attack_prior: float = Field(0.5, gt=0, lt=1, description="Probability beforehand that anybody attacks.")
    attacker_prior: float = Field(
        0.25, gt=0, lt=1, description="Probability of each teammate to attack if anybody does."
    )
    hijack: float = Field(
        DEFAULT_HAZARDS.hijack, ge=0, le=0.5, description="Per frame, that a benign teammate becomes an attacker."
    )
    recovery: float = Field(
        DEFAULT_HAZARDS.recovery, ge=0, le=0.5, description="Per frame, that an attacker becomes benign."
    )
    kind_change: float = Field(
        DEFAULT_HAZARDS.change, ge=0, le=0.5, description="Per frame, that the kind of attack changes."
    )
    first_budget: int = Field(DEFAULT_FIRST_BUDGET, ge=1, le=10_000, description="Most hypotheses in the first frame.")
    budget: int = Field(DEFAULT_LATER_BUDGET, ge=1, le=10_000, description="Most hypotheses in each later frame.")
    naming_bound: float = Field(
        DEFAULT_NAMING_BOUND, ge=0.5, lt=1, description="Probability above which an attacker is named."
    )
    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    pose_error_m: float = Field(
        DEFAULT_POSE_ERROR_M, ge=0, description="Standard deviation of the teammates' positions to expect, metres."
    )
    compare_frames: bool | None = Field(
        None,
        description="Whether boxes that come and go from frame to frame are evidence, as calibrated at 5 frames a "
        "second and with exact poses of the ego; by default if frame_period_ms is at most "
        f"{COMPARABLE_PERIOD_MS:g}.",
    )

    def at_period(self, frame_period_ms: float) -> Self:
        """With ``compare_frames`` decided."""
        if self.compare_frames is not None:
            return self
        return self.model_copy(update={"compare_frames": frame_period_ms <= COMPARABLE_PERIOD_MS})


DefenseSettings = Annotated[
    SampleConsensusSettings
    | StaticTeamSettings
    | A2CPSettings
    | GroupTestingSettings
    | HalvingSettings
    | OneByOneSettings
    | ConformalSettings
    | UndefendedSettings,
    Field(discriminator="kind"),
]
DEFENSE_KINDS = (
    "sample_consensus",
    "static_team",
    "a2cp",
    "group_testing",
    "halving",
    "one_by_one",
    "conformal",
    "none",
)


def default_defense(info: DetectorInfo) -> DefenseSettings:
    """The defence of a session that asks for none."""
    return GroupTestingSettings() if info.calibration is not None else SampleConsensusSettings()


read_defense = TypeAdapter[DefenseSettings](DefenseSettings).validate_python
"""Settings of a defence from what a session keeps of them."""


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

    teammates: Annotated[list[VehicleId], AfterValidator(_check_distinct)] = Field(min_length=1, max_length=1024)
    public_keys: PublicKeys = {}

    @field_validator("public_keys")
    @classmethod
    def _keys_of_newcomers(cls, keys: dict[str, str], others: ValidationInfo) -> dict[str, str]:
        _check_signers(keys, others.data.get("teammates", keys))
        return keys


class SessionRequest(_Request):
    """Opens a session of one ego with its teammates."""

    ego_id: VehicleId
    teammates: list[VehicleId] = Field(max_length=1024)
    detector: str | None = None
    defense: DefenseSettings | None = Field(
        None, description="By default group_testing where the detector is calibrated for it, else sample_consensus."
    )
    latency_budget_ms: float | None = Field(None, gt=0, le=60_000)
    gather_ms: float | None = Field(None, ge=0, le=60_000, description="At most the latency budget.")
    public_keys: PublicKeys = {}
    frame_period_ms: float = Field(200.0, gt=0, le=60_000, description="Time between two frames, to judge motion by.")

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


class TensorEntry(BaseModel):
    """Type and shape of one tensor."""

    dtype: str
    shape: list[int]


class DetectorEntry(BaseModel):
    """What a detector wants to be sent."""

    name: str
    tensors: dict[Literal["ego", "teammate"], dict[str, TensorEntry]]
    area_m: tuple[float, float, float, float] = Field(description="xmin, ymin, xmax, ymax; ego frame, metres")
    cell_m: float
    weights_digest: str = Field(description="SHA-256 of the weights file")
    consensus_score: float = Field(description="boxes from this score on take part in the consensus test")

    @classmethod
    def of(cls, info: DetectorInfo) -> DetectorEntry:
        """The entry of a detector."""
        return cls(
            name=info.name,
            tensors={
                role: {name: TensorEntry(dtype=spec.dtype, shape=list(spec.shape)) for name, spec in specs.items()}
                for role, specs in info.tensors.items()
            },
            area_m=info.area_m,
            cell_m=info.cell_m,
            weights_digest=info.weights_digest,
            consensus_score=info.consensus_score,
        )


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
    defense: DefenseSettings
    latency_budget_ms: float
    gather_ms: float
    frame_period_ms: float


class ChangedTeam(BaseModel):
    """The team after some joined, and the tokens of those; they are shown only here."""

    teammates: list[str]
    teammate_tokens: dict[str, str]
    tokens_expire_at: str


class RenewedToken(BaseModel):
    """A vehicle's fresh token; it is shown only here."""

    token: str
    expires_at: str


class SessionState(BaseModel):
    """A session as its ego sees it."""

    session_id: str
    ego_id: str
    teammates: list[str]
    detector: str
    defense: DefenseSettings
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
    next_seed_commitment: str = Field(description="SHA-256 of the seed of the next frame's draws.")


class Receipt(BaseModel):
    """A teammate's message is kept for its frame."""

    frame: int
    vehicle_id: str
    status: Literal["accepted"] = "accepted"
