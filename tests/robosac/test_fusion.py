import logging
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Distrust, Reason, Source, Verdict
from robosac.boxes import from_world, pose_matrix
from robosac.deadline import SAFETY
from robosac.defenses import Decision, Reference, Rejection, SampleConsensus, StaticTeam, Undefended, remembered
from robosac.fusion import fuse
from robosac.previous import PreviousAnswer
from tests.robosac.fusing import EGO, NOISE, SEEN, TEAM, FakeDetector, Stubborn, run


@pytest.mark.parametrize("seed", range(10))
def test_the_answer_is_the_verified_subset(seed):
    result = run(FakeDetector(["c"]), seed=seed)
    assert result.source is Source.CONSENSUS
    assert "c" not in result.accepted
    assert result.hypotheses[-1].teammates == result.accepted
    assert [o.verdict for o in result.hypotheses] == [Verdict.DISSENSUS] * (result.sampling_steps - 1) + [
        Verdict.CONSENSUS
    ]
    np.testing.assert_array_equal(result.boxes, SEEN)
    assert set(result.rejected) == set(TEAM) - set(result.accepted)


def test_a_defence_sees_what_was_decoded_and_what_it_was_compared_with():
    weak = np.vstack([SEEN, NOISE * [[1, 1, 1, 1, 1, 0.1]]])
    detector = FakeDetector()
    detector.detect = lambda teammates=(): weak
    (outcome,) = run(detector).hypotheses
    np.testing.assert_array_equal(outcome.boxes, weak)
    np.testing.assert_array_equal(outcome.reference, SEEN)


def test_a_defence_is_told_where_the_ego_was_and_when():
    result = run(FakeDetector(), frame=41)
    assert all(o.frame == 41 and o.pose is EGO.pose for o in result.hypotheses)


class Suspicious(Undefended):
    """Suspects one."""

    def converse(self, team, state, rng):
        decision = yield from super().converse(team, state, rng)
        return replace(decision, suspicion={"c": 0.25})


def test_the_suspicion_of_a_defence_is_in_the_result():
    assert run(FakeDetector(), Suspicious()).suspicion == {"c": 0.25}
    assert run(FakeDetector()).suspicion is None


def test_with_attackers_everywhere_the_ego_answers_alone():
    result = run(FakeDetector("abcde"))
    assert (result.source, result.accepted, result.sampling_steps) == (Source.EGO_ONLY, (), 7)
    np.testing.assert_array_equal(result.boxes, SEEN)


def test_without_teammates_only_the_ego_is_decoded():
    detector = FakeDetector()
    result = run(detector, team={})
    assert detector.decoded == [()]
    assert result.source is Source.EGO_ONLY


def test_weak_boxes_take_no_part_in_the_test():
    detector = FakeDetector()
    weak = np.vstack([SEEN, NOISE * [[1, 1, 1, 1, 1, 0.1]]])
    detector.detect = lambda teammates=(): weak if teammates else SEEN
    result = run(detector)
    assert result.hypotheses[0].jaccard_index == 1.0
    assert len(result.boxes) == 10


@pytest.mark.parametrize("budget", [0.5, 1.0, 2.5, 3.7, 5.0, 20.0])
def test_no_pass_is_begun_that_cannot_end_in_time(budget):
    detector = FakeDetector("abcde", pass_s=1.0)
    result = run(detector, due=budget)
    expected = 0
    while 1.0 + expected + SAFETY <= budget and expected < 7:
        expected += 1
    assert result.sampling_steps == expected
    assert result.out_of_time == (expected < 7)
    assert result.deadline_met == (budget >= 1.0)
    assert result.source is Source.EGO_ONLY


def test_a_slow_pass_makes_the_next_estimate_careful():
    detector = FakeDetector("abcde", pass_s=1.0)
    slow = detector.detect

    def detect(teammates=()):
        detector.now += 3.0 if teammates else 0.0
        return slow(teammates)

    detector.detect = detect
    result = run(detector, due=9.0)
    assert (result.sampling_steps, result.deadline_met) == (1, True)


def test_no_evidence_verifies_nothing(caplog):
    blind = FakeDetector()
    blind.detect = lambda teammates=(): SEEN[:0]
    with caplog.at_level(logging.CRITICAL):
        assert "UnverifiedAnswer" in run(blind, Stubborn()).fault


def test_the_threshold_of_the_defence_decides():
    detector = FakeDetector()
    half = np.vstack([SEEN, NOISE])
    detector.detect = lambda teammates=(): half if teammates else SEEN
    for threshold, source in ((0.3, Source.CONSENSUS), (0.5, Source.CONSENSUS), (0.6, Source.EGO_ONLY)):
        result = run(detector, SampleConsensus(consensus_threshold=threshold))
        assert (result.hypotheses[0].jaccard_index, result.source) == (0.5, source)


def test_a_box_at_the_consensus_score_takes_part():
    detector = FakeDetector()
    detector.detect = lambda teammates=(): SEEN - [[0, 0, 0, 0, 0, 0.4 if teammates else 0.0]]
    assert run(detector).hypotheses[0].jaccard_index == 1.0


def test_the_new_state_is_handed_back():
    result = run(FakeDetector(), StaticTeam())
    assert result.state["trusted"] == list(result.accepted)


def test_the_dearest_pass_counts_not_the_latest():
    detector = FakeDetector("abcde")
    costs = iter([1.0, 3.0, 1.0, 1.0, 1.0])
    plain = detector.detect

    def detect(teammates=()):
        detector.now += next(costs)
        return plain(teammates)

    detector.detect = detect
    result = run(detector, due=8.0)
    assert result.sampling_steps == 2


def test_a_trusted_frame_costs_one_pass_and_none_of_the_ego_alone():
    detector = FakeDetector()
    state = {"trusted": ["a", "c"], "frames_since_check": 0}
    result = run(detector, StaticTeam(), state=state)
    assert detector.decoded == [("a", "c")]
    assert (result.source, result.accepted, result.sampling_steps) == (Source.TRUSTED, ("a", "c"), 0)
    assert result.timings_ms["ego_only"] == 0.0
    assert set(result.rejected) == {"b", "d", "e"}


def test_undefended_fusion_decodes_everybody_once():
    detector = FakeDetector(["c"])
    result = run(detector, Undefended())
    assert detector.decoded == [tuple(TEAM)]
    np.testing.assert_array_equal(result.boxes, NOISE)


TEMPORAL = SampleConsensus(sampling_budget=7, collaborators=3, reference=Reference.PREVIOUS)


def test_the_previous_answer_saves_the_pass_of_the_ego_alone():
    detector = FakeDetector()
    first = run(detector, TEMPORAL, frame=4)
    assert detector.decoded[0] == ()
    detector.decoded.clear()
    second = run(detector, TEMPORAL, frame=5, previous=first.previous)
    assert second.source is Source.CONSENSUS
    assert () not in detector.decoded
    assert second.previous.frame == 5


def test_the_previous_answer_moves_with_the_ego():
    detector = FakeDetector()
    pose = pose_matrix(3.0, -1.0, 0.0, 0.4)
    before = PreviousAnswer.of(0, pose, from_world(SEEN, pose))
    assert run(detector, TEMPORAL, frame=1, previous=before).hypotheses[0].jaccard_index == 1.0
    unmoved = PreviousAnswer.of(0, EGO.pose, from_world(SEEN, pose))
    assert run(detector, TEMPORAL, frame=1, previous=unmoved).hypotheses[0].jaccard_index < 0.3


def test_after_a_gap_or_without_a_previous_answer_the_ego_is_the_reference():
    answered = PreviousAnswer.of(0, EGO.pose, NOISE)
    for frame, previous in ((2, answered), (0, answered), (1, None)):
        detector = FakeDetector()
        assert run(detector, TEMPORAL, frame=frame, previous=previous).source is Source.CONSENSUS
        assert detector.decoded[0] == ()
    misled = run(FakeDetector(), TEMPORAL, frame=1, previous=answered)
    assert misled.source is Source.EGO_ONLY
    assert misled.previous is None


def test_the_embedded_detector_end_to_end(detector, ego_message, attacked):
    results = [
        fuse(detector, SampleConsensus(collaborators=3), ego_message, attacked, rng=np.random.default_rng(seed))
        for seed in range(8)
    ]
    assert all(result.source is Source.CONSENSUS for result in results)
    assert all("car-2" not in result.accepted for result in results)
    assert any(result.sampling_steps > 1 for result in results)
    assert all(len(result.boxes) for result in results)


class Accuser(SampleConsensus):
    """Names a teammate that is there, and one that is not."""

    def converse(self, team, state, rng):
        yield [("a",)]
        why = dict.fromkeys("bcde", Rejection(Reason.NOT_SAMPLED))
        return Decision(("a",), Source.CONSENSUS, why, None, remembered({}, named=["c", "absent"]))


def test_an_answer_says_who_is_named_whatever_the_reason():
    left_out = {"absent": Rejection(Reason.MISSING), "late": Rejection(Reason.LATE)}
    result = run(FakeDetector(), Accuser())
    assert result.named == ("c", "absent")
    answer = result.answer(7, left_out, {"total": 1.23456})
    assert set(answer.named) == {"c", "absent"}
    reasons = {name: (why.reason, why.distrust) for name, why in answer.rejected.items()}
    assert reasons["absent"] == (Reason.MISSING, Distrust.NAMED)
    assert reasons["late"] == (Reason.LATE, None)
    assert (answer.frame, answer.timings_ms) == (7, {"total": 1.235})
