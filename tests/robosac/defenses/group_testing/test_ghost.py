"""The shipped detector, and one attacker that holds a single ghost still in the world."""

import numpy as np
import pytest

from robosac.answers import Reason
from robosac.calibrated import calibration_of
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.playing import play
from robosac.scenes import IntersectionScene

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


def test_without_the_object_layer_the_ghost_stays(detector, frames):
    results = played(detector, frames, judge_objects=False)
    assert any(
        at(result.boxes, frame.lies[0].box[:2]) and not result.named
        for result, frame in zip(results, frames, strict=True)
    )
    assert all(result.objects is None for result in results)
