"""The day of a city, against the same city played frame by frame."""

from dataclasses import replace

import numpy as np
import pytest
import simpy

from clients.capacity.city import KINDS, City, Day, Table, _evenly, simulate_day, traffic
from clients.capacity.costs import costs_of
from clients.capacity.needs import Scenario
from clients.capacity.replica import Outcomes, Replica, work_of
from clients.capacity.report import Report
from tests.clients.capacity.reports import a_report

COSTS = costs_of(Report.model_validate(a_report(teams=(5,))))
SMALL = Scenario(60, attacked=0.1)
PROCESSES, STAY_S, SECONDS = 6, 6.0, 60.0
DOWN_AT_S, NOTICED_S, RESTART_S, NO_DATABASE_AT_S, NO_DATABASE_S = 15.0, 2.0, 6.0, 40.0, 3.0


@pytest.fixture(scope="module")
def table():
    return Table(COSTS, SMALL, np.random.default_rng(0), frames=700)


def frame_by_frame(rng: np.random.Generator) -> Outcomes:
    """As many vehicles all the time, each on a process by chance; process 0 fails, and later the database."""
    environment = simpy.Environment()
    replicas = [Replica(environment, SMALL.budget_ms / 1e3, rng) for _ in range(PROCESSES)]
    works = {attacked: work_of(COSTS, SMALL.teammates, attacked) for attacked in (False, True)}
    others = Outcomes()

    def is_down() -> bool:
        return DOWN_AT_S <= environment.now < DOWN_AT_S + NOTICED_S + RESTART_S

    def vehicle(number: int, until: float):
        work = works[bool(rng.random() < SMALL.attacked)]
        at = int(rng.integers(int(is_down()), PROCESSES))
        yield environment.timeout(rng.uniform(0, 1 / SMALL.rate_hz))
        while environment.now < until:
            lost = at == 0 and is_down()
            if lost and environment.now >= DOWN_AT_S + NOTICED_S:
                at, lost = int(rng.integers(1, PROCESSES)), False
            if lost:
                others.frames, others.lost = others.frames + 1, others.lost + 1
            elif NO_DATABASE_AT_S <= environment.now < NO_DATABASE_AT_S + NO_DATABASE_S:
                others.frames, others.refused = others.frames + 1, others.refused + 1
            else:
                environment.process(replicas[at].frame(number, work))
            yield environment.timeout(1 / SMALL.rate_hz)

    def place(first: int):
        number = first
        while True:
            stays_s = rng.exponential(STAY_S)
            environment.process(vehicle(number, min(environment.now + stays_s, SECONDS)))
            number += SMALL.vehicles
            yield environment.timeout(stays_s)

    for first in range(SMALL.vehicles):
        environment.process(place(first))
    environment.run(SECONDS)
    return sum((replica.outcomes for replica in replicas), others)


def by_table(table: Table, rng: np.random.Generator) -> Day:
    place = City(crossings=4, stay_s=STAY_S, processes=PROCESSES, day_s=SECONDS, step_s=1.0)
    city = replace(place, noticed_s=NOTICED_S, restart_s=RESTART_S)

    def incidents(running):
        def play():
            yield running.environment.timeout(DOWN_AT_S)
            running.environment.process(running.process_down(0))
            yield running.environment.timeout(NO_DATABASE_AT_S - DOWN_AT_S)
            running.environment.process(running.database_down(0, NO_DATABASE_S))

        return [play()]

    busy = replace(SMALL, vehicles=round(SMALL.vehicles / traffic(0.0)))
    return simulate_day(city, busy, table, rng, incidents)


def test_a_day_by_the_table_agrees_with_every_frame_played(table):
    played = frame_by_frame(np.random.default_rng(1))
    told = sum((by_table(table, np.random.default_rng(seed)).outcomes for seed in range(10)), Outcomes())
    assert told.frames / 10 == pytest.approx(played.frames, rel=0.1)
    for kind, share in played.shares().items():
        assert told.shares()[kind] == pytest.approx(share, abs=0.03), kind
    assert played.refused > 0.1 * played.frames  # there was something to agree on
    assert min(played.lost, told.lost) > 0


def test_beyond_the_table_a_process_answers_no_more_frames(table):
    counts = np.array([0, 1, table.most, 2 * table.most])
    shares = table.shares(counts, 5.0)
    assert shares[1:].sum(axis=1) == pytest.approx(1.0)
    tested = shares[:, KINDS.index("tested")] * counts
    assert tested[3] == pytest.approx(tested[2])
    assert table.most_sessions(0.01) < table.most_sessions(0.2) < table.most


def test_smaller_teams_are_between_those_that_were_measured():
    table = Table(costs_of(Report.model_validate(a_report())), SMALL, np.random.default_rng(0), frames=50)
    assert table.teams == [3, 5]
    crowd = np.array([15])
    few, between, many = (table.shares(crowd, team)[0, 0] for team in (0.0, 4.0, 5.0))
    assert between == pytest.approx((few + many) / 2)
    assert few > many + 0.02


def test_new_sessions_go_where_there_are_fewest():
    rng = np.random.default_rng(0)
    for number in (0, 1, 7, 100):
        sessions = rng.integers(0, 9, 12)
        added = _evenly(sessions, number)
        assert added.sum() == number
        assert (added >= 0).all()
        after = sessions + added
        assert not number or after[added > 0].max() <= after.min() + 1


def test_traffic_has_its_peak_in_the_afternoon_and_few_at_night():
    hours = [traffic(hour / 10) for hour in range(240)]
    assert max(hours) == pytest.approx(1.0)
    assert hours.index(max(hours)) == 175
    assert min(hours) < 0.2
    assert traffic(0.0) == pytest.approx(traffic(24.0))


def a_day(table, seed=0, **changed):
    city = City(crossings=50, processes=12, day_s=7200, step_s=60, **changed)
    return simulate_day(city, replace(SMALL, vehicles=100), table, np.random.default_rng(seed))


def test_what_fails_costs_its_own_sessions_only(table):
    never = {"process_fails_s": 1e12, "database_fails_s": 1e12}
    quiet = a_day(table, **never, hashed=False)
    assert (quiet.process_failures, quiet.database_failures) == (0, 0)
    assert quiet.outcomes.lost == quiet.outcomes.refused == 0
    frames = [hour.outcomes.frames for hour in quiet.hours]
    assert frames == pytest.approx([100 * traffic(0.5) * 5 * 3600] * 2, rel=0.1)
    failing = a_day(table, **(never | {"process_fails_s": 3600}), hashed=False)
    assert failing.process_failures > 10
    assert failing.outcomes.lost > 0
    assert failing.outcomes.refused == 0
    one, many = (
        a_day(table, **(never | {"database_fails_s": 900 * shards}), databases=shards, hashed=False)
        for shards in (1, 6)
    )
    assert one.outcomes.refused > 3 * many.outcomes.refused > 0
    assert one.outcomes.lost == 0


def test_sessions_placed_evenly_are_refused_less_than_by_chance(table):
    crowded = {"process_fails_s": 1e12, "database_fails_s": 1e12}
    city = City(crossings=50, processes=6, day_s=3600, step_s=60, **crowded)
    vehicles = round(6 * table.most_sessions(0.01) / traffic(0.5) * 0.9)
    scenario = replace(SMALL, vehicles=vehicles)
    hashed, even = (
        simulate_day(replace(city, hashed=by_hash), scenario, table, np.random.default_rng(2)).outcomes.shares()
        for by_hash in (True, False)
    )
    assert even["tested"] > hashed["tested"]


def test_a_city_whose_processes_are_all_away_goes_on_once_one_is_back(table):
    day = a_day(table, process_fails_s=30.0, restart_s=300.0, database_fails_s=1e12)
    assert day.process_failures > 100
    assert 0 < day.outcomes.tested < day.outcomes.frames
