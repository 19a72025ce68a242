"""The way of what a defence judges of single boxes, to the result and the answer."""

import logging
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from robosac.answers import Source, Standing
from robosac.defenses import (
    EGO,
    Decision,
    JudgedBox,
    Reason,
    Reference,
    Rejection,
    SampleConsensus,
    StaticTeam,
    Support,
)
from robosac.fusion import fuse
from robosac.testimony import LAYERS, Testimony
from tests.robosac.fusing import NOISE, SEEN, FakeDetector, run
from tests.robosac.judging import Judging, alone, confirmed, repaired

DENIED = Support(status=Standing.CONTRADICTED, witnesses=("c",), deniers=(EGO, "d"))


class Scripted(SampleConsensus):
    """Tests these subsets, and answers with what it is told to, whatever came out."""

    def __init__(self, subsets, objects, contradicted=(), accepted=("a", "b"), **settings):
        super().__init__(**settings)
        object.__setattr__(self, "script", (subsets, objects, contradicted, accepted))

    def converse(self, team, state, rng):
        subsets, objects, contradicted, accepted = self.script
        yield subsets
        source = Source.CONSENSUS if accepted else Source.EGO_ONLY
        others = {name: Rejection(Reason.NOT_SAMPLED) for name in team if name not in accepted}
        return Decision(accepted, source, others, None, state, objects=objects, contradicted=contradicted)


class Scored(FakeDetector):
    """Every fusion shows the same five places; scores fall with the place, and are lower by so much a teammate."""

    def detect(self, teammates=()):
        self.decoded.append(tuple(teammates))
        boxes = SEEN.copy()
        boxes[:, 5] = np.array([0.9, 0.8, 0.7, 0.6, 0.5]) - 0.01 * len(teammates)
        return boxes


def judged(subset, index, support=confirmed("a")):
    return JudgedBox(subset, index, support)


def test_the_answer_is_the_judged_boxes_best_first_with_their_support():
    both, one = ("a", "b"), ("a",)
    objects = (judged(both, 3), judged(one, 0, repaired("a")), judged((), 1, alone("b")))
    left_out = (judged(both, 4, DENIED), judged(both, 2, DENIED))
    result = run(Scored(), Scripted([both, one], objects, left_out))
    assert (result.fault, result.source, result.accepted) == (None, Source.CONSENSUS, both)
    np.testing.assert_allclose(result.boxes[:, 5], [0.89, 0.8, 0.58])
    np.testing.assert_array_equal(result.boxes[:, :5], SEEN[[0, 1, 3], :5])
    assert [box.support for box in result.objects] == [repaired("a"), alone("b"), confirmed("a")]
    np.testing.assert_allclose(result.contradicted_boxes[:, 5], [0.68, 0.48])
    assert [box.index for box in result.contradicted] == [2, 4]


def test_the_answer_calls_the_ego_by_its_id():
    result = run(Scored(), Scripted([("a", "b")], (judged(("a", "b"), 0),), (judged(("a", "b"), 1, DENIED),)))
    for answer, witnesses, deniers in (
        (result.answer(7, {}, {}), ("a", "ego"), ("d", "ego")),
        (result.answer(7, {}, {}, "car-1"), ("a", "car-1"), ("car-1", "d")),
    ):
        (support,) = answer.support
        assert (support.status, support.witnesses, support.deniers) == (Standing.CONFIRMED, witnesses, ())
        (left_out,) = answer.contradicted
        assert (left_out.status, left_out.witnesses, left_out.deniers) == (Standing.CONTRADICTED, ("c",), deniers)
        np.testing.assert_allclose(left_out.box, [10, 5, 4, 2, 0, 0.78])


def test_a_defence_that_judges_no_boxes_answers_with_all_and_knows_nothing_of_them():
    result = run(FakeDetector(["c"]))
    assert (result.objects, result.contradicted) == (None, ())
    answer = result.answer(0, {}, {})
    assert (answer.support, answer.contradicted) == (None, None)


def test_a_defence_may_leave_all_boxes_out():
    left_out = tuple(judged(("a", "b"), i, DENIED) for i in range(5))
    result = run(Scored(), Scripted([("a", "b")], (), left_out))
    assert (result.fault, result.boxes.shape, result.contradicted_boxes.shape) == (None, (0, 6), (5, 6))
    answer = result.answer(0, {}, {})
    assert (answer.support, len(answer.contradicted)) == ((), 5)


def test_an_ego_only_answer_may_be_judged():
    ego = Support(status=Standing.CONFIRMED, witnesses=(EGO,), deniers=())
    result = run(Scored(), Scripted([("a",)], (judged((), 1, ego), judged((), 0, ego)), (), accepted=()))
    assert (result.fault, result.source, result.previous) == (None, Source.EGO_ONLY, None)
    np.testing.assert_array_equal(result.boxes[:, 5], [0.9, 0.8])


def test_the_next_frame_is_compared_with_what_was_answered():
    result = run(Scored(), Scripted([("a", "b")], (judged(("a", "b"), 1),), (judged(("a", "b"), 0, DENIED),)), frame=3)
    np.testing.assert_array_equal(result.previous.boxes[:, :2], SEEN[[1], :2])
    assert result.previous.frame == 3


BOTH = ("a", "b")


@pytest.mark.parametrize(
    ("objects", "contradicted", "complaint"),
    [
        ((judged(("a", "c"), 0),), (), "not all among the accepted"),
        ((), (judged(("c",), 0),), "not all among the accepted"),
        ((judged(("b",), 0),), (), "were not fused in this frame"),
        ((judged(("b", "a"), 0),), (), "were not fused in this frame"),
        ((judged(BOTH, 5),), (), "judges box 5"),
        ((judged(BOTH, -1),), (), "judges box -1"),
        ((judged((), 5),), (), "judges box 5"),
        ((judged(BOTH, 0), judged(BOTH, 0)), (), "twice"),
        ((judged(BOTH, 0),), (judged(BOTH, 0, DENIED),), "twice"),
        ((judged(BOTH, 0, alone("z")),), (), "not in the frame"),
        (None, (judged(BOTH, 0, DENIED),), "judged none"),
    ],
)
def test_a_box_that_is_not_the_defences_to_answer_with_fails_it(objects, contradicted, complaint, caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(Scored(), Scripted([BOTH, ("a", "c")], objects, contradicted))
    assert (result.source, result.objects, result.contradicted) == (Source.EGO_ONLY, None, ())
    assert "UnverifiedAnswer" in result.fault
    assert complaint in result.fault
    np.testing.assert_array_equal(result.boxes[:, 5], [0.9, 0.8, 0.7, 0.6, 0.5])


def test_the_ego_alone_can_only_be_judged_where_it_was_decoded(caplog):
    first = run(FakeDetector(), SampleConsensus(reference=Reference.PREVIOUS), frame=0)
    scripted = Scripted([BOTH], (judged((), 0),), reference=Reference.PREVIOUS)
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(), scripted, frame=1, previous=first.previous)
    assert "were not fused" in result.fault


class Trusting(StaticTeam):
    """Judges boxes of those it trusts, whom nobody has decoded."""

    def converse(self, team, state, rng):
        decision = yield from super().converse(team, state, rng)
        return replace(decision, objects=(judged(decision.accepted, 0),))


def test_what_was_not_decoded_cannot_be_judged_even_of_the_trusted(caplog):
    state = {"trusted": ["a", "c"], "frames_since_check": 0}
    with caplog.at_level(logging.CRITICAL):
        assert "were not fused" in run(FakeDetector(), Trusting(), state=state).fault


class Later(StaticTeam):
    """Judges boxes of those it trusts once they are decoded."""

    def __init__(self, objects):
        super().__init__()
        object.__setattr__(self, "objects", objects)

    asks_witnesses: ClassVar[bool] = True

    def converse(self, team, state, rng):
        decision = yield from super().converse(team, state, rng)
        return replace(decision, judge=lambda boxes, testimony: (self.objects, ()))


class Speaking(FakeDetector):
    """Has testimony of whoever is there, in which nothing is said."""

    def testify(self, ego, teammates):
        agents, size = (EGO, *teammates), (4, 4)
        maps, over_ego = np.zeros((len(agents), LAYERS, *size)), np.zeros((len(agents), *size))
        return Testimony(agents, maps, np.tile(np.eye(3), (len(agents), 1, 1)), over_ego, 32.0)


def test_what_was_not_decoded_as_a_test_may_be_judged_later(caplog):
    state = {"trusted": ["a", "c"], "frames_since_check": 0}
    both = ("a", "c")
    result = run(Speaking(), Later((judged(both, 3), judged(both, 1, alone("a")))), state=state)
    assert (result.fault, result.accepted, result.judge, len(result.boxes)) == (None, both, None, 2)
    assert sorted(box.index for box in result.objects) == [1, 3]
    assert run(FakeDetector(), Later(()), state=state).objects is None  # there is no testimony
    with caplog.at_level(logging.CRITICAL):
        assert "judges box 9" in run(Speaking(), Later((judged(both, 9),)), state=state).fault


def test_the_embedded_detector_end_to_end(detector, ego_message, benign):
    rng = np.random.default_rng(0)
    result = fuse(detector, Judging(), ego_message, benign, rng=rng)
    assert result.fault is None
    whole = detector.prepare(ego_message, benign).detect(result.accepted)
    assert len(result.boxes) + len(result.contradicted_boxes) == len(whole)
    assert 0 < len(result.contradicted_boxes) < len(whole)
    assert (np.diff(result.boxes[:, 5]) <= 0).all()
    statuses = [support.status for support in result.support("car-1")]
    assert {Standing.CONFIRMED, Standing.REPAIRED, Standing.SINGLE_WITNESS} == set(statuses)
    np.testing.assert_array_equal(result.contradicted_boxes, whole[whole[:, 5] < 0.3])


def test_an_attacked_fusion_is_not_judged():
    result = run(FakeDetector("c"), Judging())
    assert (result.fault, result.source, result.objects) == (None, Source.EGO_ONLY, None)
    assert not np.array_equal(result.boxes, NOISE)
