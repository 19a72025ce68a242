"""What a frame costs a gateway: fitted to what a load test measured."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from clients.capacity.queueing import Service
from clients.capacity.report import MeasuredLoad, Report

TIMES = ("gateway_cpu_ms", "client_cpu_ms", "machine_cpu_ms")
MEASURED = (*TIMES, "disk_bytes", "sent_bytes", "received_bytes", "audit_bytes")


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
