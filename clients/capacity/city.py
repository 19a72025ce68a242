"""A day of a city: crossings that fill and empty, processes and a database that fail.

Vehicles come to crossings by chance, more by day than by night, stay for a while, and have a session as long as they
do. Each session is placed on one process and asks for frames at its rate. What comes of the frames of a process
depends on how many sessions it has. That is looked up in a table, which the simulation of one process makes frame by
frame (`clients.capacity.replica`). So the day costs a step for each change and not for each of its billions of frames:
the flow-equivalent aggregation of K. M. Chandy, U. Herzog and L. Woo, IBM Journal of Research and Development 19, 1975.
It is right where the sessions of a process change slowly beside a frame's budget.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import simpy

from clients.capacity.costs import Costs
from clients.capacity.needs import DAY_S, Scenario
from clients.capacity.replica import Outcomes, simulate

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]
KINDS = tuple(each.name for each in fields(Outcomes))[1:]
BEYOND = 2.5
"""To how many times the sessions that saturate a process the table goes."""
LEAST_SHARE = 0.15
"""Of the peak, how many vehicles are about at night."""


@dataclass(frozen=True)
class City:
    """A city and its gateways; times in seconds."""

    crossings: int = 10_000
    stay_s: float = 60.0
    """Mean time of a vehicle at a crossing."""
    processes: int = 10_000
    hashed: bool = True
    """Whether sessions are placed by chance, as by their hash, or evenly."""
    process_fails_s: float = 30 * DAY_S
    """Mean time between failures of one process."""
    noticed_s: float = 3.0
    """From a failure to the moment from which its sessions are at others."""
    restart_s: float = 20.0
    """From that moment until it takes sessions again."""
    databases: int = 1
    """Each has the sessions of its share of the processes."""
    database_fails_s: float = DAY_S
    """Mean time between failures of one database."""
    database_back_s: float = 60.0
    """Mean time until it is back."""
    day_s: float = DAY_S
    step_s: float = 30.0
    """Between two changes of who is where."""


@dataclass
class Hour:
    """What came of the frames of an hour."""

    outcomes: Outcomes = field(default_factory=Outcomes)
    most_vehicles: int = 0


@dataclass
class Day:
    """What came of a day."""

    hours: list[Hour]
    process_failures: int = 0
    database_failures: int = 0

    @property
    def outcomes(self) -> Outcomes:
        """Of all hours."""
        return sum((hour.outcomes for hour in self.hours), Outcomes())


def traffic(hour: float) -> float:
    """How many vehicles are about at an hour, of the peak at half past five in the afternoon.

    Two rush hours and a flatter noon over what there is at night: the largest of three bell curves.
    """

    def bell(at: float, width: float, height: float) -> float:
        away = min(abs(hour - at), 24 - abs(hour - at))
        return height * math.exp(-((away / width) ** 2))

    return LEAST_SHARE + (1 - LEAST_SHARE) * max(bell(8.0, 1.6, 0.9), bell(17.5, 2.0, 1.0), bell(13.0, 5.0, 0.6))


class Table:
    """What comes of the frames of a process, as shares, by how many sessions it has.

    Parameters
    ----------
    costs : Costs
    scenario : Scenario
        ``teammates`` is the largest team; the smallest that was measured is in the table as well.
    rng : Generator
    frames : int
        That are simulated for each number of sessions, at least.
    """

    def __init__(self, costs: Costs, scenario: Scenario, rng: np.random.Generator, frames: int = 4000) -> None:
        self.teams = sorted({min(*costs.teams, scenario.teammates), scenario.teammates})
        saturated = max(1e3 / scenario.rate_hz / costs.service(team, scenario.attacked).mean for team in self.teams)
        self.most = max(2, math.ceil(BEYOND * saturated))
        self._shares = np.stack(
            [self._of_team(costs, replace(scenario, teammates=team), rng, frames) for team in self.teams]
        )

    def _of_team(self, costs: Costs, scenario: Scenario, rng: np.random.Generator, frames: int) -> Floats:
        rows = [np.zeros(len(KINDS))]
        for sessions in range(1, self.most + 1):
            told = Outcomes()
            while told.frames < frames:
                told += simulate(costs, scenario, sessions, 5.0, rng)  # anew, since phases stay as they begin
            rows.append(np.array(list(told.shares().values())))
        return np.stack(rows)

    def shares(self, sessions: Counts, team: float) -> Floats:
        """For each process the shares of its frames, (processes, kinds), where a session has so many teammates.

        Beyond the table a process answers as many frames as at its end, and refuses the others.
        """
        at = np.interp(team, self.teams, np.arange(len(self.teams)))
        low, high = math.floor(at), math.ceil(at)
        known = np.minimum(sessions, self.most)
        shares = (1 - at + low) * self._shares[low, known] + (at - low) * self._shares[high, known]
        shares = shares * (known / np.maximum(sessions, 1))[:, None]
        shares[:, KINDS.index("refused")] += 1 - known / np.maximum(sessions, 1)
        return np.asarray(shares)

    def most_sessions(self, late: float) -> int:
        """The most sessions of which no more than this share of the frames has no tested answer in time."""
        tested = self._shares[-1, 1:, KINDS.index("tested")]
        enough = np.flatnonzero(tested < 1 - late)
        return int(enough[0]) if len(enough) else self.most


class _Running:
    """A day on its way."""

    def __init__(self, city: City, scenario: Scenario, table: Table, rng: np.random.Generator) -> None:
        self.city, self.scenario, self.table, self.rng = city, scenario, table, rng
        self.environment = simpy.Environment()
        popular = rng.lognormal(0.0, 0.8, city.crossings)
        self.means = scenario.vehicles * popular / popular.sum()
        self.at_crossing: Counts = rng.poisson(self.means * traffic(0.0))
        self.takes = np.ones(city.processes, dtype=bool)
        self.down = np.zeros(city.processes, dtype=bool)
        self.sessions: Counts = np.zeros(city.processes, dtype=np.int64)
        self.database = np.arange(city.processes) % city.databases
        self.failures_of: Counts = np.zeros(city.databases, dtype=np.int64)
        self.told_s = 0.0
        self.day = Day([Hour() for _ in range(math.ceil(city.day_s / 3600))])
        self.place(int(self.at_crossing.sum()))

    def place(self, number: int) -> None:
        """Put new sessions on the processes that take some; with none, they wait for the first that does."""
        if not self.takes.any():
            self.environment.process(self._later(number))
        elif self.city.hashed:
            self.sessions[self.takes] += self.rng.multinomial(number, np.full(self.takes.sum(), 1 / self.takes.sum()))
        else:
            self.sessions[self.takes] += _evenly(self.sessions[self.takes], number)

    def _later(self, number: int) -> Generator[simpy.Event, Any, None]:
        yield self.environment.timeout(self.city.step_s)
        self.place(number)

    def tell(self) -> None:
        """Count the frames since this was called last; what changes is changed afterwards."""
        now = self.environment.now
        frames = self.sessions * (self.scenario.rate_hz * (now - self.told_s))
        hour = self.day.hours[min(int(self.told_s // 3600), len(self.day.hours) - 1)]
        self.told_s = now
        if not frames.any():
            return
        present = self.at_crossing[self.at_crossing > 0]
        team = (
            float(np.average(np.minimum(present - 1, self.scenario.teammates), weights=present))
            if len(present)
            else 0.0
        )
        shares = self.table.shares(self.sessions, team)
        shares[(self.failures_of > 0)[self.database]] = np.equal(KINDS, "refused")
        shares[self.down] = np.equal(KINDS, "lost")
        hour.outcomes += Outcomes(float(frames.sum()), *(frames @ shares).tolist())
        hour.most_vehicles = max(hour.most_vehicles, int(self.sessions.sum()))

    def vehicles(self) -> Generator[simpy.Event, Any, None]:
        """Vehicles come and go."""
        city, leave = self.city, -math.expm1(-self.city.step_s / self.city.stay_s)
        while True:
            yield self.environment.timeout(city.step_s)
            self.tell()
            wanted = self.means * traffic(self.environment.now / 3600 % 24)
            left = self.rng.binomial(self.at_crossing, leave)
            come = self.rng.poisson(wanted * leave)
            self.at_crossing += come - left
            gone = min(int(left.sum()), int(self.sessions.sum()))
            self.sessions -= self.rng.multivariate_hypergeometric(self.sessions, gone, method="marginals")
            self.place(int(come.sum()))

    def processes_fail(self) -> Generator[simpy.Event, Any, None]:
        """Now and then one of the processes fails."""
        while True:
            yield self.environment.timeout(self.rng.exponential(self.city.process_fails_s / self.city.processes))
            up = np.flatnonzero(self.takes)
            if len(up):
                self.environment.process(self.process_down(int(self.rng.choice(up))))

    def process_down(self, number: int) -> Generator[simpy.Event, Any, None]:
        """A process fails, its sessions move, and it comes back."""
        self.tell()
        self.day.process_failures += 1
        self.down[number] = True
        yield self.environment.timeout(self.city.noticed_s)
        self.tell()
        moved, self.sessions[number] = int(self.sessions[number]), 0
        self.takes[number] = False
        self.place(moved)
        yield self.environment.timeout(self.city.restart_s)
        self.tell()
        self.takes[number], self.down[number] = True, False

    def databases_fail(self) -> Generator[simpy.Event, Any, None]:
        """Now and then one of the databases is away."""
        city = self.city
        while True:
            yield self.environment.timeout(self.rng.exponential(city.database_fails_s / city.databases))
            away_s = self.rng.exponential(city.database_back_s)
            self.environment.process(self.database_down(int(self.rng.integers(city.databases)), away_s))

    def database_down(self, number: int, seconds: float) -> Generator[simpy.Event, Any, None]:
        """A database is away for a time: every frame of its sessions is refused."""
        self.tell()
        self.day.database_failures += 1
        self.failures_of[number] += 1
        yield self.environment.timeout(seconds)
        self.tell()
        self.failures_of[number] -= 1


def _evenly(sessions: Counts, number: int) -> Counts:
    """How many of some new sessions go where, so that those that have fewest get more."""
    order = np.argsort(sessions, kind="stable")
    have = sessions[order]
    filled = np.arange(1, len(have) + 1) * have - np.cumsum(have)  # to lift all before to the level of each
    lifted = int(np.searchsorted(filled, number, side="right"))
    level, rest = divmod(number + int(have[:lifted].sum()), lifted)
    after = np.full(lifted, level)
    after[:rest] += 1
    added = np.zeros(len(sessions), dtype=np.int64)
    added[order[:lifted]] = after - have[:lifted]
    return added


Incidents = Callable[[_Running], Sequence[Generator[simpy.Event, Any, None]]]


def simulate_day(
    city: City,
    scenario: Scenario,
    table: Table,
    rng: np.random.Generator,
    incidents: Incidents | None = None,
) -> Day:
    """A day of a city.

    Parameters
    ----------
    city : City
    scenario : Scenario
        ``vehicles`` are those about at the peak.
    table : Table
    rng : Generator
    incidents : callable, optional
        What fails, as processes of the simulation; by default what fails by chance.
    """
    running = _Running(city, scenario, table, rng)
    start = running.environment.process
    start(running.vehicles())
    for incident in incidents(running) if incidents else (running.processes_fail(), running.databases_fail()):
        start(incident)
    for hour in range(len(running.day.hours)):
        running.environment.run(min((hour + 1) * 3600, city.day_s))
        running.tell()
    return running.day
