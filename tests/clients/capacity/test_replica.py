from dataclasses import replace

import numpy as np
import pytest
import simpy

from clients.capacity.costs import costs_of
from clients.capacity.needs import Scenario
from clients.capacity.replica import Outcomes, Replica, Work, simulate, work_of
from clients.capacity.report import Report
from tests.clients.capacity.reports import a_report

COSTS = costs_of(Report.model_validate(a_report()))
HONEST = Scenario(1)


def outcomes(works, budget_s=0.2):
    """Of frames that come at once, one a session."""
    environment = simpy.Environment()
    replica = Replica(environment, budget_s, np.random.default_rng(0))
    for number, work in enumerate(works):
        environment.process(replica.frame(number, work))
    environment.run()
    return replica.outcomes, environment.now


A_FRAME = Work(before=0.006, begin=0.011, step=0.0075, after=0.004, waits=0.005, steps={1: 1}, spread=0.0)


def test_a_frame_alone_takes_what_it_takes():
    told, ended = outcomes([A_FRAME])
    assert told == Outcomes(frames=1, tested=1)
    assert ended == pytest.approx(0.0335)
    work = work_of(COSTS, 5, attacked=False)
    assert work.before + work.expected + work.after == pytest.approx(0.0285)
    assert work.waits == pytest.approx(0.037 - 0.0285 - 0.004)  # less what the client takes
    assert work.begin / work.before == pytest.approx(11 / 6)


def test_a_process_does_one_thing_at_a_time_and_waits_for_the_disk_meanwhile():
    told, ended = outcomes([A_FRAME, A_FRAME])
    assert told.tested == 2
    assert ended == pytest.approx(2 * (0.006 + 0.0185 + 0.004) + 0.005)


def test_frames_are_refused_where_those_in_hand_take_half_of_the_time():
    told, _ = outcomes([A_FRAME] * 12)
    assert told.refused == 12 - 5  # 0.5 (0.2 - 0.0335) / 0.0185 = 4.5: the frame itself, and four others
    assert told.tested == 5


def test_three_frames_of_a_session_are_in_hand_at_a_time():
    environment = simpy.Environment()
    replica = Replica(environment, 2.0, np.random.default_rng(0))
    for _ in range(5):
        environment.process(replica.frame(1, A_FRAME))
    environment.run()
    assert replica.outcomes == Outcomes(frames=5, tested=3, refused=2)


def test_no_hypothesis_is_begun_that_would_end_too_late():
    told, ended = outcomes([replace(A_FRAME, steps={100: 1})])
    assert told == Outcomes(frames=1, tested=1)
    assert 0.19 < ended <= 0.2
    assert outcomes([A_FRAME], budget_s=0.027)[0] == Outcomes(frames=1, untested=1)
    assert outcomes([A_FRAME], budget_s=0.02)[0] == Outcomes(frames=1, late=1)


def test_shares_add_up_and_fall_with_the_load():
    tested = []
    for sessions in (4, 10, 16, 30):
        told = simulate(COSTS, replace(HONEST, attacked=0.1), sessions, 4.0, np.random.default_rng(1))
        assert told.frames == pytest.approx(sessions * 20, abs=1)
        assert sum(told.shares().values()) == pytest.approx(1.0)
        tested.append(told.shares()["tested"])
    assert tested[0] == 1.0
    assert sorted(tested, reverse=True) == tested
    assert tested[-1] * 30 * 5 == pytest.approx(1 / COSTS.service(5, 0.1).mean * 1e3, rel=0.15)  # saturated
