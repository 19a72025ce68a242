"""Decoding several subsets at once changes when they are decoded, and nothing of the answer."""

from types import SimpleNamespace

import numpy as np
import pytest

from robosac.ahead import Ahead
from robosac.answers import Verdict
from robosac.deadline import Deadline
from robosac.defenses import A2CP, Batch, Decision, Halving, SampleConsensus, Source
from robosac.passes import Passes, together
from robosac.session import Session, defense_for
from tests.robosac.fusing import TEAM, FakeDetector, Stubborn, run

DEFENSES = [
    {"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3},
    {"kind": "sample_consensus", "sampling_budget": 10, "collaborators": 1, "reference": "previous"},
    {"kind": "static_team", "recheck_every": 2},
    {"kind": "a2cp"},
    {"kind": "halving"},
    {"kind": "one_by_one"},
    {"kind": "group_testing"},
    {"kind": "none"},
]


class Together:
    """A detector whose frames decode so many at once, each as it does alone; ``passes`` has what was decoded together.

    So answers can be compared digit by digit: where all maps are fused in one, sums are made in another order.
    """

    def __init__(self, detector, worth):
        self.info, self._detector, self.worth = detector.info, detector, worth
        self.passes = []

    def prepare(self, ego, teammates):
        prepared = self._detector.prepare(ego, teammates)

        def detect_all(subsets):
            self.passes.append(tuple(subsets))
            return [prepared.detect(subset) for subset in subsets]

        return SimpleNamespace(detect=lambda s=(): detect_all([s])[0], detect_all=detect_all, worth=self.worth)


def answers(detector, settings, ego, teammates, frames=4):
    rng = np.random.default_rng(5)
    session = Session(detector, list(teammates), defense_for(settings, detector.info), rng=rng)
    results = [session.answer(frame, ego, teammates) for frame in range(frames)]
    return results, rng.bit_generator.state


@pytest.mark.parametrize("threshold", [0.3, 0.999])
@pytest.mark.parametrize("settings", DEFENSES, ids=lambda s: s["kind"])
def test_answers_are_the_same(settings, threshold, detector, ego_message, attacked):
    if settings["kind"] != "none":
        settings = {**settings, "consensus_threshold": threshold}
    single, several = Together(detector, 1), Together(detector, 8)
    (expected, draws), (found, same_draws) = (answers(d, settings, ego_message, attacked) for d in (single, several))
    assert draws == same_draws
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
        assert one.fault is None
        for name in ("accepted", "source", "hypotheses", "sampling_steps", "rejected", "state", "suspicion", "objects"):
            assert getattr(one, name) == getattr(other, name), name
    asked = {subset for decoded in single.passes for subset in decoded}
    assert asked <= {subset for decoded in several.passes for subset in decoded}
    assert len(several.passes) <= len(single.passes)
    assert max(map(len, single.passes)) == 1


@pytest.mark.parametrize("settings", DEFENSES[:4] + DEFENSES[6:7], ids=lambda s: s["kind"])
def test_with_one_product_for_all_maps_they_are_but_for_rounding(settings, detector, ego_message, attacked):
    pair = [answers(d, settings, ego_message, attacked)[0] for d in (detector, detector.on_device("cpu", worth=8))]
    for one, other in zip(*pair, strict=True):
        assert (one.accepted, one.sampling_steps) == (other.accepted, other.sampling_steps)
        assert [o.verdict for o in one.hypotheses] == [o.verdict for o in other.hypotheses]
        np.testing.assert_allclose(one.boxes, other.boxes, atol=1e-3)


@pytest.mark.parametrize("defense", [SampleConsensus(sampling_budget=7, collaborators=3), A2CP(sampling_budget=7)])
def test_as_long_as_nothing_is_in_consensus_it_is_known_what_is_asked_next(defense):
    detector = Together(FakeDetector("abcde"), 8)
    detector.clock = lambda: 0.0
    result = run(detector, defense)
    assert result.sampling_steps == 7
    asked = dict.fromkeys(outcome.teammates for outcome in result.hypotheses)  # A2CP may ask twice
    assert detector.passes == [((), *asked)]


def test_a_probe_that_is_no_evidence_is_followed_by_others():
    """It was taken for a dissensus in what was offered: then it only takes more passes."""
    blind = FakeDetector()
    blind.detect = lambda teammates=(): np.zeros((0, 6))
    detectors = [Together(blind, worth) for worth in (1, 8)]
    results = []
    for detector in detectors:
        detector.clock = lambda: 0.0
        results.append(run(detector, A2CP(sampling_budget=7)))
    assert results[0].hypotheses == results[1].hypotheses
    assert {o.verdict for o in results[0].hypotheses} == {Verdict.NO_EVIDENCE}


def test_those_of_a_plain_list_are_decoded_at_once():
    detector = Together(FakeDetector("a"), 4)
    detector.clock = lambda: 0.0
    run(detector, Halving())
    first, second, *_ = detector.passes
    assert first == ((), tuple("abcde"))
    assert len(second) == 2


def test_group_testing_offers_its_answer_without_each(detector, ego_message, benign):
    several = Together(detector, 16)
    answers(several, {"kind": "group_testing"}, ego_message, benign, frames=4)
    first, team = several.passes[0], tuple(sorted(benign))
    assert {team, *(tuple(n for n in team if n != out) for out in team)} <= set(first)
    single = Together(detector, 1)
    answers(single, {"kind": "group_testing"}, ego_message, benign, frames=4)
    assert len(several.passes) < 0.6 * len(single.passes)


def test_without_time_only_the_ego_is_decoded():
    detector = Together(FakeDetector("abcde"), 8)
    detector.clock = lambda: 1.0
    result = run(detector, due=0.5)
    assert detector.passes == [((),)]
    assert result.out_of_time
    assert result.hypotheses == ()


def test_no_more_are_decoded_at_once_than_have_time_one_after_the_other():
    detector = Together(FakeDetector("abcde", pass_s=1.0), 4)
    detector.clock = detector._detector.clock
    result = run(detector, due=10.3)  # once four seconds have gone into one, a pass is expected to take four
    assert [len(decoded) for decoded in detector.passes] == [4, 1, 1]
    assert len(result.hypotheses) == 5
    assert result.out_of_time


def test_what_is_decoded_takes_no_time_to_be_tested():
    detector = Together(FakeDetector("abcde", pass_s=1.0), 8)
    detector.clock = detector._detector.clock
    result = run(detector, due=8.5)
    assert len(detector.passes) == 1
    assert len(result.hypotheses) == 7
    assert not result.out_of_time


def test_no_more_are_decoded_than_may_be_tested():
    detector, deadline = Together(FakeDetector("abcde"), 8), Deadline(hypotheses=2)
    passes = Passes(detector.prepare(None, {}), deadline, {})
    passes.decode((), [("a",), ("b",), ("c",)])
    assert detector.passes == [((), ("a",), ("b",))]
    assert deadline.another_fits(takes_a_pass=False)
    passes.decode(("d",), [("e",), ("f",)])
    assert detector.passes[1:] == [(("d",), ("e",))]


def test_each_is_decoded_once_and_kept_apart_until_it_is_asked_for():
    detector, boxes = Together(FakeDetector(), 3), {}
    passes = Passes(detector.prepare(None, {}), Deadline(), boxes)
    passes.decode(("a",), [("a",), ("b",), ("b",), (), ("c",)])
    assert detector.passes == [(("a",), ("b",), ())]
    assert set(boxes) == {("a",)}
    assert not passes.takes(("b",))
    assert passes.takes(("c",))
    passes.decode(("b",), [("c",)])
    passes.decode(("b",))
    assert (len(detector.passes), set(boxes)) == (1, {("a",), ("b",)})


class Boaster(Stubborn):
    """Answers with what it only offered."""

    def converse(self, team, state, rng):
        yield Batch([("a", "c")], lambda: [("a", "b")])
        return Decision(("a", "b"), Source.CONSENSUS, dict.fromkeys("cde"), None, state)


def test_what_was_only_offered_is_not_verified(caplog):
    detector = Together(FakeDetector(), 8)
    detector.clock = lambda: 0.0
    result = run(detector, Boaster(sampling_budget=7, collaborators=3))
    assert detector.passes[0] == ((), ("a", "c"), ("a", "b"))
    assert result.source is Source.EGO_ONLY
    assert "UnverifiedAnswer" in result.fault


def test_nothing_is_offered_where_one_is_decoded_at_a_time():
    def offered():
        pytest.fail("it was asked")

    class Offering(SampleConsensus):
        def converse(self, team, state, rng):
            yield Batch([("a", "c")], offered)
            return (yield from super().converse(team, state, rng))

    assert run(FakeDetector(), Offering(sampling_budget=7, collaborators=3), TEAM).fault is None


@pytest.mark.parametrize("known", [True, False])
def test_what_the_ego_sees_alone_may_be_known_before(known, detector, ego_message, attacked):
    several = Together(detector, 8)
    ahead = Ahead(several, ego_message)
    if known:
        ahead.see_alone()
        several.passes.clear()
    defense = defense_for(DEFENSES[0], detector.info)
    session = Session(detector, list(attacked), defense, rng=np.random.default_rng(3))
    result = session.answer(0, ego_message, attacked, detector=ahead)
    assert result.fault is None
    assert result.sampling_steps > 0
    assert (() in several.passes[0]) != known
    assert len(several.passes[0]) > 1


class Family:
    """Frames that are decoded together; ``passes`` has what was."""

    worth, family = 4, "family"

    def __init__(self, passes):
        self.passes = passes

    def detect(self, teammates=()):
        return self.detect_all([teammates])[0]

    def detect_all(self, subsets):
        return self.detect_together([(self, subsets)])[0]

    def detect_together(self, wanted):
        self.passes.append([tuple(subsets) for _, subsets in wanted])
        return [[np.full((1, 6), len(subset)) for subset in subsets] for _, subsets in wanted]


def test_passes_of_several_frames_are_made_as_one():
    made, boxes = [], [{}, {}]
    frames = [Passes(Family(made), Deadline(), of_frame) for of_frame in boxes]
    coming = [frames[0].coming(("a",), [("b",), ("c",)]), frames[1].coming((), [("a", "b")])]
    assert made == []
    together(coming, most=5)
    assert made == [[(("a",), ("b",)), ((), ("a", "b"))]]
    assert all(each.spent_s > 0 for each in coming)
    assert boxes == [{}, {}]
    assert frames[0].decode(("b",))[0, 0] == 1
    assert frames[1].decode(("a", "b"))[0, 0] == 2
    assert not frames[1].takes(())
    assert frames[0].takes(("c",))
    assert len(made) == 1


def test_what_is_asked_for_is_decoded_however_many_ask():
    made = []
    coming = [Passes(Family(made), Deadline(), {}).coming(("a",), [("b",)]) for _ in range(3)]
    together(coming, most=2)
    assert made == [[(("a",),)] * 3]


def test_a_pass_with_others_tells_what_one_takes():
    clock = SimpleNamespace(now=0.0)
    deadline = Deadline(at=1.0, clock=lambda: clock.now)
    passes = Passes(Family([]), deadline, {})
    passes.keep([("a",)], [np.zeros((0, 6))], took_s=0.5)
    assert deadline.another_fits()
    clock.now = 0.45
    assert not deadline.another_fits()
    assert deadline.another_fits(takes_a_pass=False)


def test_what_takes_no_pass_or_is_decoded_alone_is_not_made_with_others():
    single = Together(FakeDetector(), 4).prepare(None, {})
    assert Passes(single, Deadline(), {}).coming(("a",)) is None
    passes = Passes(Family([]), Deadline(), {}, {(): np.zeros((0, 6))})
    assert passes.coming(()) is None
    assert passes.coming(("a",)) is not None
