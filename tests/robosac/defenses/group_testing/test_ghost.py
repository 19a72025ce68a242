"""The shipped detector, and one attacker that holds a single ghost still in the world."""

import numpy as np
import pytest

from robosac.answers import Reason, Source, Standing
from robosac.calibrated import calibration_of
from robosac.deadline import Deadline
from robosac.defenses import trusted_in
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.playing import play
from robosac.scenes import IntersectionScene
from robosac.session import Session

LIAR, NEAR_M = "car-3", 2.0


@pytest.fixture(scope="module")
def frames(detector):
    return Encounters(detector, IntersectionScene(1600)).sequence(5, "ghost", [LIAR])


def at(boxes, place):
    return int((np.hypot(*(boxes[:, :2] - place).T) < NEAR_M).sum())


def played(detector, frames, **settings):
    defense = GroupTestingSettings(**settings).build(calibration_of(detector.info))
    return [answer.result for answer in play(defense, frames, np.random.default_rng(0))]


def test_a_ghost_is_in_no_answer_and_its_attacker_named(detector, frames):
    results = played(detector, frames)
    ghosts = [frame.lies[0].box[:2] for frame in frames]
    for frame, ghost in zip(frames, ghosts, strict=True):  # undefended fusion shows it
        assert at(frame.prepare(frame.ego, frame.teammates).detect(frame.team), ghost) == 1
    assert [at(result.boxes, ghost) for result, ghost in zip(results, ghosts, strict=True)] == [0] * 5
    assert {name for result in results for name in result.named} == {LIAR}
    last = results[-1]
    assert set(last.accepted) == set(frames[-1].team) - {LIAR}
    assert last.rejected[LIAR].reason is Reason.DISTRUSTED
    audited = [item for item in last.rejected[LIAR].evidence["evidence"] if item["test"] == "objects"]
    assert any("ghost" in item["kinds"] for item in audited)


def hurried(detector, **settings):
    """Two honest frames, and one with ghosts of somebody who is trusted by then, in which no test has time."""
    encounters = Encounters(detector, IntersectionScene(1600))
    honest, attacked = encounters.sequence(2), encounters.sequence(3, "ghosts", [LIAR])
    session = Session(detector, honest[0].team, GroupTestingSettings(**settings).build(calibration_of(detector.info)))
    for number, frame in enumerate(honest):
        session.answer(number, frame.ego, frame.teammates)
    assert LIAR in trusted_in(session.state)
    last = attacked[-1]
    return last, session.answer(2, last.ego, last.teammates, deadline=Deadline(hypotheses=0))


def test_ghosts_of_the_trusted_are_left_out_though_no_test_had_time(detector):
    frame, result = hurried(detector)
    assert (result.source, set(result.accepted), result.hypotheses) == (Source.TRUSTED, set(frame.team), ())
    whole = frame.prepare(frame.ego, frame.teammates).detect(frame.team)
    shown = [at(whole, lie.box[:2]) for lie in frame.lies]
    assert (len(shown), min(shown)) == (5, 1)
    told = [at(result.boxes, lie.box[:2]) < seen for lie, seen in zip(frame.lies, shown, strict=True)]
    assert sum(told) >= 4
    assert len(result.boxes) + len(result.contradicted_boxes) == len(whole)
    assert all(box.support.deniers for box in result.contradicted)


def test_a_session_may_keep_in_what_is_contradicted_though_no_test_had_time(detector):
    frame, result = hurried(detector, keep_contradicted=True)
    whole = frame.prepare(frame.ego, frame.teammates).detect(frame.team)
    assert (len(result.boxes), result.contradicted) == (len(whole), ())
    assert Standing.CONTRADICTED in {box.support.status for box in result.objects}


def test_boxes_of_the_ego_alone_are_judged(detector, frames):
    """Nobody else is there; or nobody is believed."""
    for settings, team in (({}, []), ({"attack_prior": 1 - 1e-9, "attacker_prior": 1 - 1e-9}, frames[0].team)):
        session = Session(detector, team, GroupTestingSettings(**settings).build(calibration_of(detector.info)))
        result = session.answer(0, frames[0].ego, {name: frames[0].teammates[name] for name in team})
        assert (result.source, len(result.objects)) == (Source.EGO_ONLY, len(result.boxes))
        assert bool(result.hypotheses) == bool(team)
        statuses = {box.support.status for box in result.objects if "" in box.support.witnesses}
        assert statuses == {Standing.CONFIRMED}


def test_without_the_object_layer_the_ghost_stays(detector, frames):
    results = played(detector, frames, judge_objects=False)
    assert any(
        at(result.boxes, frame.lies[0].box[:2]) and not result.named
        for result, frame in zip(results, frames, strict=True)
    )
    assert all(result.objects is None for result in results)
