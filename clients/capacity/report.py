"""What the capacity model reads of a load test's report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from robosac.faults import in_words

Positive = Field(gt=0, allow_inf_nan=False)
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Tested(BaseModel):
    """The frames of a load that tested so many hypotheses."""

    model_config = ConfigDict(frozen=True)

    frames: int = Field(ge=1)
    engine_ms: float = Positive
    engine_spread_ms: float = Field(ge=0, allow_inf_nan=False)
    latency_ms: float = Positive


class MeasuredPace(BaseModel):
    """Of the machine, before a load: see `clients.machine.Pace`."""

    model_config = ConfigDict(frozen=True)

    alone_ms: float = Positive
    together_ms: float = Positive


class MeasuredLoad(BaseModel):
    """One load of a load test's report that got answers."""

    model_config = ConfigDict(frozen=True)

    loop: Literal["closed", "open"]
    egos: int = Field(ge=1)
    attacked: bool
    rate_hz: float | None = Field(None, gt=0)
    teammates: int = Field(ge=1)
    frames: int = Field(ge=1)
    fps: float = Positive
    sampling_steps_mean: float = Field(ge=0, allow_inf_nan=False)
    by_steps: dict[int, Tested] = Field(min_length=1)
    used_a_frame: dict[str, Amount | None]
    stages_ms: dict[str, Amount]
    errors: dict[str, int]
    placed: list[int] | None = None
    """Egos of each process; None where it is not known."""
    pace: MeasuredPace | None = None
    """None in reports of older versions, and where costs were not measured."""

    @field_validator("used_a_frame")
    @classmethod
    def _takes_time(cls, used: dict[str, float | None]) -> dict[str, float | None]:
        for name in ("gateway_cpu_ms", "machine_cpu_ms"):
            if used.get(name) == 0:
                raise ValueError(f"{name} must be above 0: no frame is decided without processor time")
        return used

    def slowness(self, reference_ms: float | None, others: float) -> float:
        """By how much more processor time a computation takes in this load than at the reference's pace on a core
        beside which none works.

        Parameters
        ----------
        reference_ms : float or None
            `MeasuredPace.alone_ms` of the reference; None: not known.
        others : float
            Share of the other cores that work at the same time; they share caches and power.
        """
        if self.pace is None or reference_ms is None:
            return 1.0
        return (self.pace.alone_ms + (self.pace.together_ms - self.pace.alone_ms) * others) / reference_ms


class MeasuredMachine(BaseModel):
    """Where a load test ran."""

    cores: int = Field(ge=1)
    platform: str = "unknown"
    processor: str = ""
    python: str = "unknown"

    @property
    def words(self) -> str:
        """In a sentence."""
        processor = f" of {self.processor}" if self.processor else ""
        return f"The load test ran on {self.cores} cores{processor}, {self.platform}, Python {self.python}."


class Report(BaseModel):
    """What the capacity model reads of ``load_test.json``."""

    model_config = ConfigDict(frozen=True)

    machine: MeasuredMachine
    processes: int = Field(ge=1)
    defense: dict[str, Any]
    loads: list[MeasuredLoad] = Field(min_length=1)

    @property
    def kind(self) -> str:
        """Of the defence."""
        return str(self.defense.get("kind"))


def read_report(path: Path) -> Report:
    """A load test's report.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is none, or has no costs; the message names the field.
    """
    try:
        return Report.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise ValueError(f"{path}: {where}: {in_words(first)} (reports come from `robosac load-test --out`)") from error
