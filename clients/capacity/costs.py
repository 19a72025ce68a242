"""What a frame costs a gateway: fitted to what a load test measured."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.optimize import nnls

from clients.capacity.queueing import Service

TIMES = ("gateway_cpu_ms", "client_cpu_ms", "machine_cpu_ms")
MEASURED = (*TIMES, "disk_bytes", "sent_bytes", "received_bytes", "audit_bytes")
Positive = Field(gt=0, allow_inf_nan=False)


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
    used_a_frame: dict[str, float | None]
    stages_ms: dict[str, float]
    errors: dict[str, int]
    placed: list[int] | None = None
    """Egos of each process; None where it is not known."""
    pace: MeasuredPace | None = None
    """None in reports of older versions, and where costs were not measured."""

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
        raise ValueError(f"{path}: {where}: {first['msg']} (reports come from `robosac load-test --out`)") from error


@dataclass(frozen=True)
class Line:
    """A cost that grows with teammates and with hypotheses tested."""

    base: float
    teammate: float
    step: float

    def at(self, teammates: float, steps: float) -> float:
        """The cost of a frame."""
        return self.base + self.teammate * teammates + self.step * steps

    @classmethod
    def through(cls, points: Sequence[tuple[float, float, float, float]]) -> Line:
        """The one with the least squared errors that has no cost below zero.

        Parameters
        ----------
        points : sequence of (teammates, steps, cost, weight)
        """
        teammates, steps, costs, weights = np.array(points).T
        columns = np.stack([np.ones_like(costs), teammates, steps], axis=1)
        if np.ptp(teammates) == 0:
            columns[:, 1] = 0.0
        if np.ptp(steps) == 0:
            columns[:, 2] = 0.0
        found, _ = nnls(columns * np.sqrt(weights)[:, None], costs * np.sqrt(weights))
        return cls(*map(float, found))


@dataclass(frozen=True)
class Costs:
    """What a frame costs, by teammates and hypotheses tested; times in milliseconds."""

    kind: str
    """Of the defence."""
    teams: tuple[int, ...]
    """Numbers of teammates that were measured."""
    engine_ms: Line
    """On the detector's thread."""
    latency_ms: Line
    """From the moment that a frame is due to its answer, where nothing else is in hand."""
    used: Mapping[str, Line | None]
    """Each of `MEASURED`; None where it could not be measured."""
    spread: float
    """Standard deviation of the time on the detector's thread for the same number of hypotheses, of its mean."""
    steps: Mapping[tuple[bool, int], Mapping[int, int]]
    """How many frames tested so many hypotheses, by whether there was an attacker, and by the teammates."""
    receive_ms: float
    store_ms: float
    pace_ms: float | None
    """Of the machine, as `MeasuredPace.alone_ms`, to which times are reduced; None where it was not measured."""

    def check_team(self, teammates: int) -> None:
        """Refuse a number of teammates of whose cost nothing is known.

        Raises
        ------
        ValueError
        """
        if len(self.teams) == 1 and teammates != self.teams[0]:
            raise ValueError(
                f"{teammates} teammates: the load test measured {self.teams[0]} only, so it is not known what one "
                "costs; measure with --teammates 3 --teammates 5"
            )

    def steps_at(self, attacked: bool, teammates: float) -> Mapping[int, int]:
        """Frames by the hypotheses that they tested, of the team that was measured and is nearest in size."""
        team = min((team for at, team in self.steps if at is attacked), key=lambda team: abs(team - teammates))
        return self.steps[attacked, team]

    def mean_steps(self, attacked: bool, teammates: float) -> float:
        """Hypotheses tested in a frame."""
        counts = self.steps_at(attacked, teammates)
        return sum(steps * count for steps, count in counts.items()) / sum(counts.values())

    def mixed(self, line: Line, teammates: float, attacked_share: float) -> float:
        """A cost, where a share of the sessions is attacked."""
        honest, attacked = (line.at(teammates, self.mean_steps(at, teammates)) for at in (False, True))
        return (1 - attacked_share) * honest + attacked_share * attacked

    def service(self, teammates: float, attacked_share: float) -> Service:
        """The processor time of a frame, where a share of the sessions is attacked.

        Raises
        ------
        ValueError
            If it was not measured.
        """
        cpu_ms = self.known("gateway_cpu_ms")
        mean = square = 0.0
        for attacked, share in ((False, 1 - attacked_share), (True, attacked_share)):
            counts = self.steps_at(attacked, teammates)
            for steps, count in counts.items():
                own, part = cpu_ms.at(teammates, steps), share * count / sum(counts.values())
                mean += part * own
                square += part * own**2 * (1 + self.spread**2)
        return Service(mean, square)

    def known(self, name: str) -> Line:
        """One of `MEASURED`.

        Raises
        ------
        ValueError
            If it was not measured.
        """
        line = self.used.get(name)
        if line is None:
            raise ValueError(f"the report has no {name}: the gateway's /metrics did not tell, or not in every load")
        return line

    def a_frame(self, name: str, teammates: float, attacked_share: float) -> float | None:
        """One of `MEASURED`, where a share of the sessions is attacked."""
        line = self.used.get(name)
        return None if line is None else self.mixed(line, teammates, attacked_share)


def calibration(report: Report) -> list[MeasuredLoad]:
    """The loads that costs are fitted to, where hardly a frame waits for another: those of a single ego in a closed
    loop, and those in an open loop with the fewest egos.
    """
    fewest = min((load.egos for load in report.loads if load.loop == "open"), default=0)
    return [load for load in report.loads if load.egos == (1 if load.loop == "closed" else fewest)]


def costs_of(report: Report) -> Costs:
    """The costs that a load test measured.

    Raises
    ------
    ValueError
        If nothing can be fitted to loads without and with an attacker.
    """
    loads = calibration(report)
    by_attack = {at: [load for load in loads if load.attacked is at] for at in (False, True)}
    if not all(by_attack.values()):
        raise ValueError("the report has no loads of single egos, without and with an attacker, to take the costs from")

    paces = [load.pace.alone_ms for load in loads if load.pace is not None]
    pace_ms = float(np.median(paces)) if len(paces) == len(loads) else None
    slow = [load.slowness(pace_ms, _others(report, load)) for load in loads]

    def used(name: str) -> Line | None:
        points = [
            (load.teammates, load.sampling_steps_mean, cost / (slower if name in TIMES else 1.0), load.frames)
            for load, slower in zip(loads, slow, strict=True)
            if (cost := load.used_a_frame.get(name)) is not None
        ]
        return Line.through(points) if len(points) == len(loads) else None

    tested = [
        (load.teammates, steps, of, slower)
        for load, slower in zip(loads, slow, strict=True)
        for steps, of in load.by_steps.items()
    ]
    frames = [of.frames for _, _, of, _ in tested]
    counts: defaultdict[tuple[bool, int], Counter[int]] = defaultdict(Counter)
    for load in loads:
        counts[load.attacked, load.teammates].update({steps: of.frames for steps, of in load.by_steps.items()})
    return Costs(
        kind=report.kind,
        teams=tuple(sorted({load.teammates for load in loads})),
        engine_ms=Line.through([(team, steps, of.engine_ms / slower, of.frames) for team, steps, of, slower in tested]),
        latency_ms=Line.through(
            [(team, steps, of.latency_ms / slower, of.frames) for team, steps, of, slower in tested]
        ),
        used={name: used(name) for name in MEASURED},
        spread=float(np.average([of.engine_spread_ms / of.engine_ms for _, _, of, _ in tested], weights=frames)),
        steps=counts,
        receive_ms=float(np.mean([load.stages_ms.get("receive", 0.0) for load in loads])),
        store_ms=float(np.mean([load.stages_ms.get("store", 0.0) for load in loads])),
        pace_ms=pace_ms,
    )


def _others(report: Report, load: MeasuredLoad) -> float:
    gateway_ms, machine_ms = (load.used_a_frame.get(name) for name in ("gateway_cpu_ms", "machine_cpu_ms"))
    if gateway_ms is None or machine_ms is None:
        return 0.0
    return others_at_work(load.fps, gateway_ms, machine_ms, report.processes, report.machine.cores)


def others_at_work(fps: float, gateway_ms: float, machine_ms: float, processes: int, cores: int) -> float:
    """Share of the other cores that work while a gateway's process does, from the processor time that a frame takes of
    all gateways and of the whole machine.
    """
    if cores == 1:
        return 0.0
    working = fps * (machine_ms - gateway_ms / processes) / 1e3
    return min(1.0, max(0.0, working / (cores - 1)))
