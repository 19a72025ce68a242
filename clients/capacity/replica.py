"""One gateway process under load, frame by frame: a simulation of discrete events.

A frame comes from a session that keeps its period. The process reads it, decides it pass by pass, and stores the
decision. It does one thing at a time, as the interpreter's lock lets only one of its threads work. Between two passes
whoever is due first goes first. As in the gateway, a frame is refused where those in hand are
expected to take more than half of the time that it can spare, or where three of its session are in hand, and no
hypothesis is begun that can not be expected to end in time.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import simpy

from clients.capacity.costs import Costs
from clients.capacity.needs import SHARE, Scenario

SESSION_FRAMES = 3
"""Frames of one session in hand at a time."""
Events = Generator[simpy.Event, Any, None]


@dataclass
class Outcomes:
    """What came of frames; all but `frames` are disjoint."""

    frames: float = 0
    tested: float = 0
    """Answered in time, a hypothesis was tested."""
    untested: float = 0
    """Answered in time from what the ego sees, as there was no time for a test."""
    late: float = 0
    """Answered too late."""
    refused: float = 0
    """Refused at once, as overloaded or without a database."""
    lost: float = 0
    """Without an answer, as the process is down."""

    def __add__(self, other: Outcomes) -> Outcomes:
        return Outcomes(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def shares(self) -> dict[str, float]:
        """Each outcome's share of the frames."""
        return {each.name: getattr(self, each.name) / self.frames for each in fields(self)[1:]}


@dataclass(frozen=True)
class Work:
    """What a frame takes, in seconds, and how many hypotheses it needs."""

    before: float
    """Until the detector begins."""
    begin: float
    """In the detector, before the first hypothesis."""
    step: float
    after: float
    """Once it is decided."""
    waits: float
    """For what takes no processor time, such as a disk."""
    steps: Mapping[int, int]
    """How often so many hypotheses are needed."""
    spread: float

    @property
    def expected(self) -> float:
        """Mean time in the detector, by which frames are admitted."""
        return self.begin + self.step * sum(n * count for n, count in self.steps.items()) / sum(self.steps.values())


def work_of(costs: Costs, teammates: int, attacked: bool) -> Work:
    """What a frame of a session takes: its processor time, split as its stages are.

    Raises
    ------
    ValueError
        If the load test knows no processor time.
    """
    cpu, client = costs.known("gateway_cpu_ms"), costs.known("client_cpu_ms")
    at = (teammates, costs.mean_steps(attacked, teammates))
    stages = np.array([costs.receive_ms, costs.engine_ms.at(teammates, 0), costs.store_ms])
    before, begin, after = (cpu.at(teammates, 0) * stages / stages.sum() / 1e3).tolist()
    waits_ms = max(0.0, costs.latency_ms.at(*at) - cpu.at(*at) - client.at(*at))
    return Work(before, begin, cpu.step / 1e3, after, waits_ms / 1e3, costs.steps_at(attacked, teammates), costs.spread)


class Replica:
    """A process and its frames.

    Parameters
    ----------
    environment : simpy.Environment
    budget_s : float
    rng : Generator
    """

    def __init__(self, environment: simpy.Environment, budget_s: float, rng: np.random.Generator) -> None:
        self._environment = environment
        self._budget_s = budget_s
        self._rng = rng
        self._turn = simpy.PriorityResource(environment)
        self._in_hand: dict[int, list[float]] = {}
        self.outcomes = Outcomes()

    def session(self, number: int, work: Work, period_s: float, until_s: float) -> Events:
        """The frames of a session: one each period, from a random moment on."""
        yield self._environment.timeout(self._rng.uniform(0, period_s))
        while self._environment.now < until_s:
            self._environment.process(self.frame(number, work))
            yield self._environment.timeout(period_s)

    def frame(self, session: int, work: Work) -> Events:
        """One frame, from its head to its answer."""
        self.outcomes.frames += 1
        due = self._environment.now + self._budget_s
        if not self._admits(session, work):
            self.outcomes.refused += 1
            return
        mine = self._in_hand.setdefault(session, [])
        mine.append(work.expected)
        yield from self._hold(due, work.before)
        tested = yield from self._decide(work, due)
        mine.pop()
        if not mine:
            del self._in_hand[session]
        yield from self._hold(due, work.after)
        yield self._environment.timeout(work.waits)
        if self._environment.now > due:
            self.outcomes.late += 1
        elif tested:
            self.outcomes.tested += 1
        else:
            self.outcomes.untested += 1

    def _admits(self, session: int, work: Work) -> bool:
        if not self._in_hand:
            return True
        others = sum(min(sum(wanted), work.expected) for of, wanted in self._in_hand.items() if of != session)
        own = self._in_hand.get(session, ())
        spare = self._budget_s - work.expected - work.before - work.after - work.waits
        return len(own) < SESSION_FRAMES and sum(own) + others <= SHARE * spare

    def _decide(self, work: Work, due: float) -> Generator[simpy.Event, Any, int]:
        """Hypotheses that were tested."""
        factor = max(0.1, self._rng.normal(1.0, work.spread))
        yield from self._hold(due, work.begin * factor)
        numbers, counts = zip(*work.steps.items(), strict=True)
        needed = int(self._rng.choice(numbers, p=np.divide(counts, sum(counts))))
        ends = due - work.after - work.waits
        for tested in range(needed):
            if self._environment.now + work.step > ends:
                return tested
            yield from self._hold(due, work.step * factor)
        return needed

    def _hold(self, due: float, seconds: float) -> Events:
        with self._turn.request(priority=round(due * 1e9)) as turn:
            yield turn
            yield self._environment.timeout(seconds)


def simulate(costs: Costs, scenario: Scenario, sessions: int, seconds: float, rng: np.random.Generator) -> Outcomes:
    """What comes of the frames of so many sessions of one process; each is attacked by chance."""
    environment = simpy.Environment()
    replica = Replica(environment, scenario.budget_ms / 1e3, rng)
    works = {attacked: work_of(costs, scenario.teammates, attacked) for attacked in (False, True)}
    for number in range(sessions):
        work = works[bool(rng.random() < scenario.attacked)]
        environment.process(replica.session(number, work, 1 / scenario.rate_hz, seconds))
    environment.run()
    return replica.outcomes
