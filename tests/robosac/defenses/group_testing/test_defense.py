import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.boxes import from_world, pose_matrix
from robosac.defenses import Outcome
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.defenses.group_testing.evidence import Evidence
from tests.robosac.defenses.group_testing.conversing import SEEN, TEAM, outcome, run_frame, shifted
from tests.robosac.defenses.group_testing.sessions import DEFENSE, named, run, with_settings


@pytest.mark.parametrize("bad", [(), ("car-3",), ("car-2", "rsu"), ("car-2", "car-4", "car-5")])
def test_attackers_are_named_and_everybody_else_is_used(bad, rng):
    decision, tested = run(DEFENSE, bad, 8, rng)
    assert set(decision.accepted) == set(TEAM) - set(bad)
    assert decision.source is Source.CONSENSUS
    assert named(decision) == set(bad)
    assert set(decision.suspicion) == set(TEAM)
    assert set(decision.state["trusted"]) == set(TEAM) - set(bad)
    assert len(tested[0]) <= 7 + 4
    assert max(map(len, tested[1:])) <= 4 + 4
    assert len(tested[-1]) < 4


@pytest.mark.parametrize(("inspections", "first", "later"), [(0, 7, 4), (2, 9, 6)])
def test_those_excluded_are_asked_again_beyond_the_budget(inspections, first, later, rng):
    """Alone and beside the answer, in each frame: so that they are named or cleared."""
    bad = {"car-2", "car-4", "car-5"}
    decision, tested = run(with_settings(inspections=inspections), bad, 8, rng)
    assert len(tested[0]) <= first
    assert max(map(len, tested[1:])) <= later
    assert bad.isdisjoint(decision.accepted)
    assert (named(decision) == bad) == (inspections > 0)


def test_who_stays_where_it_is_is_left_out_and_not_named(rng):
    """What is odd about a teammate may be the world: to be named, its own fusions have to flicker beside the ego's."""
    decision, _ = run(DEFENSE, ["car-3"], 8, rng, judge=lambda subset, bad, frame: still(outcome(subset, bad), frame))
    assert decision.suspicion["car-3"] > 0.95
    assert set(decision.accepted) == set(TEAM) - {"car-3"}
    assert named(decision) == set()
    apart, _ = run(with_settings(compare_frames=False), ["car-3"], 8, rng)
    assert apart.suspicion["car-3"] > 0.95
    assert named(apart) == set()


def test_who_is_suspected_is_told_apart_from_who_was_not_sampled(rng):
    state, seen = DEFENSE.initial_state(TEAM), set()
    for _ in range(12):
        decision, tested = run_frame(DEFENSE, state, TEAM, ["car-3"], rng, most=1)
        state = json.loads(json.dumps(decision.state))
        against = {name for one in tested if one.verdict is Verdict.DISSENSUS for name in one.teammates}
        for name, why in decision.rejected.items():
            if name not in against and why.reason is not Reason.DISTRUSTED:
                expected = Reason.SUSPECTED if decision.suspicion[name] >= 0.5 else Reason.NOT_SAMPLED
                assert why.reason is expected
                seen.add((name == "car-3", why.reason))
    assert (True, Reason.SUSPECTED) in seen
    assert (False, Reason.SUSPECTED) not in seen
    assert Reason.NOT_SAMPLED in {reason for _, reason in seen}


def still(shown, frame):
    return replace(shown, frame=frame)


def test_the_evidence_on_a_named_attacker_is_given_item_by_item(rng):
    decision, _ = run(DEFENSE, ["car-3"], 3, rng)
    rejection = decision.rejected["car-3"]
    items = rejection.evidence["evidence"]
    assert rejection.evidence["suspicion"] > 0.99
    against = [item for item in items if item["log_likelihood_ratio"] > 0]
    assert len({tuple(sorted([*i["teammates"], *i.get("joining", [])])) for i in against}) >= 2
    for item in items:
        assert item["test"] in ("ego", "pair", "change")
        assert item["frame"] in range(3)
        assert ("jaccard_index" in item) == (item["test"] == "ego")
        assert ("joining" in item) == (item["test"] == "pair")
        assert {"boxes", "changes"} <= set(item) if item["test"] == "change" else {"loss", "novelty"} <= set(item)
        assert item["teammates"]


def test_memory_keeps_which_way_a_test_spoke(rng):
    honest, _ = run(DEFENSE, [], 2, rng)
    assert {sign for _, sign in honest.state["memory"]["tests"].values()} == {-1}
    attacked, _ = run(DEFENSE, TEAM, 2, rng)
    assert {sign for _, sign in attacked.state["memory"]["tests"].values()} == {1}


def test_the_same_subset_again_and_again_names_nobody():
    defense = with_settings(attack_prior=0.9, attacker_prior=0.9, first_budget=1, budget=1)
    decision, tested = run(defense, ["solo"], 12, np.random.default_rng(0), team=("solo",))
    assert {o.teammates for frame in tested for o in frame} <= {("solo",)}
    assert named(decision) == set()
    assert decision.accepted == ()


def one_pass_by_budget(state, bad, rng):
    return run_frame(with_settings(first_budget=1, budget=1, inspections=0), state, TEAM, bad, rng)


def one_pass_by_time(state, bad, rng):
    return run_frame(DEFENSE, state, TEAM, bad, rng, most=1)


@pytest.mark.parametrize("bad", [(), ("car-3",)])
@pytest.mark.parametrize("frame", [one_pass_by_budget, one_pass_by_time])
def test_with_one_pass_a_frame_the_team_is_found_in_time(frame, bad, rng):
    """The answer that is known is worth most in each frame by itself; so nobody would ever be tested besides."""
    state, tests = DEFENSE.initial_state(TEAM), []
    for _ in range(20):
        decision, tested = frame(state, bad, rng)
        state = json.loads(json.dumps(decision.state))
        tests.append(len(tested))
    assert tests == [1] * 20
    assert set(decision.accepted) == set(TEAM) - set(bad)


def test_a_frame_with_time_for_more_is_as_if_none_had_been_hurried(rng):
    hurried, _ = run_frame(DEFENSE, DEFENSE.initial_state(TEAM), TEAM, [], rng, most=1)
    assert hurried.state["memory"]["hurried"]
    honest, _ = run(DEFENSE, [], 4, rng, hurried.state)
    assert not honest.state["memory"]["hurried"]


def test_a_hijacked_teammate_is_found_and_one_that_recovers_is_used_again(rng):
    honest, _ = run(DEFENSE, [], 6, rng)
    hijacked, _ = run(DEFENSE, ["car-4"], 4, rng, honest.state)
    assert named(hijacked) == {"car-4"}
    assert "car-4" not in hijacked.state["trusted"]
    quick = with_settings(recovery=0.05)
    again, _ = run(quick, [], 40, rng, hijacked.state)
    assert named(again) == set()
    assert "car-4" in again.accepted
    assert "car-4" not in again.state["memory"]["evidence"]


@pytest.mark.parametrize("hazards", [{"hijack": 0}, {"hijack": 0, "recovery": 0, "kind_change": 0}])
def test_who_was_long_honest_is_found_though_nobody_is_expected_to_be_hijacked(hazards, rng):
    """What is believed is rounded when it is kept: after some honest frames an attack would be impossible."""
    defense = with_settings(**hazards)
    honest, _ = run(defense, [], 40, rng)
    decision, _ = run(defense, ["car-4"], 14, rng, honest.state)
    assert decision.suspicion["car-4"] > 0.99
    assert set(decision.accepted) == set(TEAM) - {"car-4"}


def test_an_attacker_that_spoils_what_an_honest_one_joins_is_blamed_itself(rng):
    """It agrees with the ego, and moves boxes only where others are in the fusion: alone it is steady, so that it is
    left out, and not named.
    """

    def judge(subset, attackers, frame):
        spoiled = "car-2" in subset and len(subset) > 1
        boxes = shifted(subset, frame) if spoiled else SEEN
        return Outcome(subset, 0.93, Verdict.CONSENSUS, boxes, SEEN, np.eye(4), frame, alone=SEEN)

    state = DEFENSE.initial_state(TEAM)
    for _ in range(15):
        decision, _ = run_frame(DEFENSE, state, TEAM, [], rng, judge=judge)
        state = decision.state
        assert named(decision) == set()
    assert {name for name, p in decision.suspicion.items() if p > 0.5} == {"car-2"}
    assert set(decision.accepted) == set(TEAM) - {"car-2"}


class Flitting:
    """A world in which an attacker adds boxes that nobody can check, somewhere else in every frame; the ego drives."""

    def __init__(self, frames=range(100), attackers=("car-4",)):
        self.frames, self.attackers, self.tests = frames, attackers, 0

    def judge(self, frame, subset, *_):
        pose = pose_matrix(3.0 * frame, 0.0, 0.0, 0.0)
        added = np.array([[50.0, 20.0 + 9 * i + 2 * (frame % 3), 4.0, 2.0, 0.0, 0.9] for i in range(6)])
        flitting = not set(self.attackers).isdisjoint(subset)
        boxes, seen = from_world(np.vstack([SEEN, added]) if flitting else SEEN, pose), from_world(SEEN, pose)
        return Outcome(subset, 0.5, Verdict.CONSENSUS, boxes, seen, pose, frame, alone=seen)

    def last(self, defense, count=12):
        rng, state = np.random.default_rng(0), defense.initial_state(TEAM)
        for _, frame in zip(range(count), self.frames, strict=False):
            decision, tested = run_frame(defense, state, TEAM, [], rng, judge=partial(self.judge, frame))
            self.tests += len(tested)
            state = json.loads(json.dumps(decision.state))
        return decision


def test_boxes_that_come_and_go_give_an_attacker_away():
    decision = Flitting().last(DEFENSE)
    assert named(decision) == {"car-4"}
    assert max(decision.suspicion, key=decision.suspicion.get) == "car-4"
    assert decision.suspicion["car-4"] > 0.9
    assert set(decision.accepted) == set(TEAM) - {"car-4"}
    changes = [i for i in decision.state["memory"]["evidence"]["car-4"] if i["test"] == "change"]
    against = [i for i in changes if "car-4" in i["teammates"]]
    assert against
    assert all((i["boxes"], i["changes"]) == (14, 12) and i["log_likelihood_ratio"] > 0 for i in against)


def test_only_what_the_latest_frame_showed_is_kept():
    world, rng, state = Flitting(), np.random.default_rng(0), DEFENSE.initial_state(TEAM)
    for frame in range(3):
        decision, tested = run_frame(DEFENSE, state, TEAM, [], rng, judge=partial(world.judge, frame))
        state = decision.state
        memory = state["memory"]
        assert (len(memory["shown"]), memory["shown_in"]) == (len(tested) + 1, frame)  # and the ego alone
    unseen, _ = run_frame(DEFENSE, state, TEAM, [], rng, most=0)
    assert unseen.state["memory"]["shown"] == {}


def test_honest_boxes_stay_where_they_are():
    honest = Flitting(attackers=()).last(DEFENSE)
    assert set(honest.accepted) == set(TEAM)
    assert max(honest.suspicion.values()) < 0.01


@pytest.mark.parametrize(
    ("defense", "frames"),
    [(with_settings(compare_frames=False), range(100)), (DEFENSE, range(0, 100, 2)), (DEFENSE, [7] * 100)],
)
def test_frames_that_do_not_follow_on_one_another_are_not_compared(defense, frames):
    world, apart = Flitting(frames), Flitting(frames)
    decision = world.last(defense)
    apart.last(with_settings(compare_frames=False))
    assert world.tests <= 1.2 * apart.tests
    assert max(decision.suspicion.values()) < 0.5
    assert set(decision.accepted) == set(TEAM)


@pytest.mark.parametrize(
    ("settings", "expected"), [({}, 0.2), ({"frame_period_ms": 50.0}, 0.05), ({"frame_period_ms": 1e-6}, 0.001)]
)
def test_what_is_known_of_a_frame_tells_how_long_it_lasts(settings, expected, rng):
    periods = []

    class Noting(Evidence):
        def __init__(self, known, **options):
            periods.append(known.period_s)
            super().__init__(known, **options)

    run(replace(with_settings(**settings), evidence=Noting), [], 2, rng)
    assert periods == pytest.approx([expected] * 2)


def test_what_is_left_open_is_decided_by_the_period_of_a_session():
    decided = GroupTestingSettings().at_period(50.0)
    assert (decided.frame_period_ms, decided.compare_frames) == (50.0, True)
    asked = GroupTestingSettings(frame_period_ms=100.0).at_period(500.0)
    assert (asked.frame_period_ms, asked.compare_frames) == (100.0, False)


def test_an_empty_fusion_has_nothing_that_could_change():
    def suspicion(defense):
        state = defense.initial_state(TEAM)
        for frame in range(3):
            here = pose_matrix(0, 0, 0, 0), frame
            decision, _ = run_frame(
                defense,
                state,
                TEAM,
                [],
                np.random.default_rng(0),
                judge=lambda subset, _, __, here=here: Outcome(
                    subset, 0.0, Verdict.DISSENSUS, SEEN[:0], SEEN[:0], *here
                ),
            )
            state = decision.state
        return decision.suspicion

    assert suspicion(DEFENSE) == suspicion(with_settings(compare_frames=False))
