"""What is worked out before all messages are there changes nothing of the answer."""

import numpy as np
import pytest

from robosac.ahead import Ahead
from robosac.deadline import Deadline
from robosac.defenses import EGO
from robosac.session import Session, defense_for
from tests.robosac import fusing
from tests.robosac.fusing import FakeDetector

SETTINGS = [{"kind": "group_testing"}, {"kind": "sample_consensus"}, {"kind": "none"}]


def answered(detector, settings, ego, teammates, ahead=None):
    session = Session(detector, list(teammates), defense_for(settings, detector.info), rng=np.random.default_rng(3))
    return session.answer(0, ego, teammates, detector=ahead)


def same(first, second):
    np.testing.assert_array_equal(first.boxes, second.boxes)
    assert (first.accepted, first.hypotheses, first.suspicion) == (second.accepted, second.hypotheses, second.suspicion)
    assert first.objects == second.objects


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s["kind"])
@pytest.mark.parametrize("known", ["nothing", "the ego", "some", "all"])
def test_the_answer_is_the_same_whatever_was_known_before(settings, known, detector, ego_message, attacked):
    ahead = Ahead(detector, ego_message)
    if known != "nothing":
        ahead.see_alone()
        ahead.read(EGO, ego_message)
    for name in {"some": ["rsu", "car-3"], "all": list(attacked)}.get(known, []):
        ahead.lay(name, attacked[name])
        ahead.read(name, attacked[name])
    at_once = answered(detector, settings, ego_message, attacked)
    same(answered(detector, settings, ego_message, attacked, ahead), at_once)
    same(
        answered(detector, settings, ego_message, attacked, ahead), at_once
    )  # and again, after a try that was not kept


def test_of_a_message_that_came_otherwise_only_the_latter_counts(detector, ego_message, benign, attacked):
    ahead = Ahead(detector, ego_message)
    for name, message in benign.items():
        ahead.lay(name, message)
        ahead.read(name, message)
    settings = {"kind": "group_testing"}
    same(
        answered(detector, settings, ego_message, attacked, ahead), answered(detector, settings, ego_message, attacked)
    )


def test_who_left_is_not_heard(detector, ego_message, benign):
    ahead = Ahead(detector, ego_message)
    ahead.read("car-2", benign["car-2"])
    ahead.prepare(ego_message, {name: message for name, message in benign.items() if name != "car-2"})
    assert ahead.said == {}


def test_another_message_of_the_ego_is_not_taken_for_the_first(detector, ego_message, benign):
    with pytest.raises(ValueError, match="another message of the ego"):
        Ahead(detector, ego_message).prepare(benign["rsu"], {})


def test_the_ego_is_not_decoded_again_and_its_pass_still_tells_what_one_costs():
    detector = FakeDetector()
    ahead = Ahead(detector, fusing.EGO)
    ahead.see_alone()
    ahead.pass_s = 0.5
    deadline = Deadline(at=10.0, clock=detector.clock)
    session = Session(detector, list("abcde"), defense_for({"kind": "sample_consensus"}, detector.info), screening=None)
    result = session.answer(0, fusing.EGO, fusing.TEAM, deadline, detector=ahead)
    assert result.accepted
    assert detector.decoded.count(()) == 1
    detector.now = 9.45
    assert not deadline.another_fits()
    detector.now = 9.35
    assert deadline.another_fits()


def test_a_detector_that_adds_nobody_later_is_asked_for_the_whole_frame():
    detector = FakeDetector()
    ahead = Ahead(detector, fusing.EGO)
    ahead.lay("a", fusing.EGO)
    assert len(ahead.prepare(fusing.EGO, fusing.TEAM).detect(("a",))) == len(fusing.SEEN)
