import json

import numpy as np
import pytest

from robosac.answers import Source, Verdict
from robosac.defenses import GroupTesting, Outcome
from robosac.defenses.group_testing import OPEN, GroupTestingSettings
from robosac.defenses.group_testing.defense import HIJACKED_OF
from robosac.defenses.group_testing.lies import RULES
from robosac.defenses.group_testing.memory import FORGETTING_FRAMES, MAX_LEFT, Memory
from tests.robosac.defenses.group_testing import one_place
from tests.robosac.defenses.group_testing.conversing import SEEN, TEAM, make_model, outcome, run_frame
from tests.robosac.defenses.group_testing.sessions import DEFENSE, named, run, with_settings


def test_what_an_older_version_remembered_is_taken_over(rng):
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    memory = {key: value for key, value in known.state["memory"].items() if not key.startswith("shown")}
    later, _ = run(DEFENSE, ["car-3"], 1, rng, {**known.state, "memory": memory})
    assert named(later) == {"car-3"}


def test_an_ego_that_sees_nothing_falls_back_on_whom_it_trusts(rng):
    def blind(subset, attackers, frame):
        return Outcome(subset, 0.0, Verdict.DISSENSUS, SEEN[:0], SEEN[:0])

    first, _ = run(DEFENSE, [], 1, rng, judge=blind)
    assert (first.source, first.accepted) == (Source.EGO_ONLY, ())
    prior = DEFENSE.initial_state(TEAM)["suspicion"]
    assert first.suspicion == pytest.approx(prior, abs=1e-4)
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    later, _ = run(DEFENSE, [], 1, rng, known.state, judge=blind)
    assert later.source is Source.TRUSTED
    assert set(later.accepted) == set(TEAM) - {"car-3"}
    assert later.state["trusted"] == known.state["trusted"]


def test_one_box_is_too_little_for_a_consensus(rng):
    def nearly_blind(subset, attackers, frame):
        return Outcome(subset, 1.0, Verdict.CONSENSUS, SEEN[:1], SEEN[:1])

    decision, _ = run(DEFENSE, [], 3, rng, judge=nearly_blind)
    assert (decision.source, decision.accepted, decision.state["trusted"]) == (Source.EGO_ONLY, (), [])


def test_without_time_whom_it_trusts_is_the_answer(rng):
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    hurried, tested = run(DEFENSE, ["car-3"], 1, rng, known.state, most=0)
    assert tested == [[]]
    assert (hurried.source, set(hurried.accepted)) == (Source.TRUSTED, set(TEAM) - {"car-3"})
    fresh, _ = run(DEFENSE, [], 1, rng, most=0)
    assert fresh.source is Source.EGO_ONLY


def test_a_team_that_changes(rng):
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    without = DEFENSE.change_team(known.state, [name for name in TEAM if name != "car-3"])
    assert "car-3" not in without["suspicion"]
    assert without["named"] == []
    back = DEFENSE.change_team(json.loads(json.dumps(without)), TEAM)
    assert back["suspicion"]["car-3"] == pytest.approx(known.suspicion["car-3"], abs=1e-4)
    assert "car-3" not in back["trusted"]
    assert back["named"] == known.state["named"] == ["car-3"]
    long_ago = {**without, "memory": {**without["memory"], "frame": int(20 * FORGETTING_FRAMES)}}
    stranger = DEFENSE.change_team(without, [*without["suspicion"], "new"])["suspicion"]["new"]
    assert DEFENSE.change_team(long_ago, TEAM)["suspicion"]["car-3"] == pytest.approx(
        stranger, abs=5e-3
    )  # who knows of an attack
    assert 0.05 < stranger < 0.25
    decision, _ = run(DEFENSE, [], 1, rng, long_ago)
    assert named(decision) == set()


def test_whoever_returns_is_held_to_what_it_did():
    """It had left in the hope to be as one that never lied."""
    known = one_place.ERASED.play(5, quiet=4)[-1][0].state
    assert known["named"] == [one_place.LIAR]
    without = one_place.DEFENSE.change_team(known, [name for name in TEAM if name != one_place.LIAR])
    away, rng = without, np.random.default_rng(0)
    for _ in range(3):
        decision, _ = run_frame(
            one_place.DEFENSE,
            away,
            tuple(n for n in TEAM if n != one_place.LIAR),
            [],
            rng,
            judge=one_place.HONEST.judge,
        )
        away = json.loads(json.dumps(decision.state))
    back = one_place.DEFENSE.change_team(away, TEAM)
    assert back["named"] == [one_place.LIAR]
    levels, before = (state["memory"]["lies"]["levels"][one_place.LIAR] for state in (back, known))
    assert levels == {kind: pytest.approx(pair, rel=0.01) for kind, pair in before.items()}
    decision, _ = run_frame(one_place.DEFENSE, back, TEAM, [], rng, judge=one_place.HONEST.judge)
    assert decision.named == (one_place.LIAR,)
    assert one_place.LIAR not in decision.accepted


def test_whoever_returns_with_a_frame_is_held_to_it_too():
    """The library has no team but that of each frame."""
    known = one_place.ERASED.play(5, quiet=4)[-1][0].state
    without = one_place.DEFENSE.change_team(known, [name for name in TEAM if name != one_place.LIAR])
    without["memory"]["lies"]["levels"] = {}
    without["memory"]["left"][one_place.LIAR][3] = {}
    rng = np.random.default_rng(0)
    decision, _ = run_frame(one_place.DEFENSE, without, TEAM, [], rng, judge=one_place.HONEST.judge)
    assert decision.named == (one_place.LIAR,)


def test_what_an_older_version_remembered_of_who_left_is_taken_over():
    known = one_place.ERASED.play(5, quiet=4)[-1][0].state
    without = one_place.DEFENSE.change_team(known, [name for name in TEAM if name != one_place.LIAR])
    without["memory"]["left"] = {name: of[:2] for name, of in without["memory"]["left"].items()}
    back = one_place.DEFENSE.change_team(without, TEAM)
    assert back["suspicion"][one_place.LIAR] > 0.9
    assert back["named"] == []


def test_the_latest_who_left_are_remembered_in_whatever_order_they_are_kept():
    memory = Memory()
    for number in range(MAX_LEFT):
        memory.frame = number
        memory.leave(f"car-{MAX_LEFT - number:04d}", 0.5, named=False)
    memory = Memory.from_state(json.loads(json.dumps(memory.to_state(), sort_keys=True)))
    memory.leave("one more", 0.5, named=False)
    assert set(memory.left) == {"one more", *(f"car-{MAX_LEFT - number:04d}" for number in range(1, MAX_LEFT))}


def test_an_absent_teammate_keeps_what_is_known_of_it(rng):
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    present = tuple(name for name in TEAM if name != "car-3")
    decision, tested = run(DEFENSE, [], 2, rng, known.state, team=present)
    assert all("car-3" not in o.teammates for frame in tested for o in frame)
    assert decision.suspicion["car-3"] > 0.9
    assert set(decision.rejected) == set(present) - set(decision.accepted)


def test_a_calibration_with_other_kinds_begins_again_with_the_same_team(rng):
    known, _ = run(DEFENSE, ["car-3"], 5, rng)
    other = GroupTesting(make_model(("pgd", OPEN)))
    decision, _ = run(other, ["car-3"], 3, rng, known.state)
    assert named(decision) == {"car-3"}
    assert len(decision.state["posterior"]["weights"]) == 3


def test_fifty_teammates(rng):
    team = tuple(f"v{i:02d}" for i in range(50))
    bad = {"v07", "v19", "v42"}
    state, seen = DEFENSE.initial_state(team), set()
    for _ in range(25):
        decision, tested = run_frame(DEFENSE, state, team, bad, rng)
        state = json.loads(json.dumps(decision.state))
        assert bad.isdisjoint(decision.accepted)
        seen |= set(decision.state["named"])
    assert len(tested) <= 4 + 4
    assert seen == bad
    assert len(json.dumps(state)) < 100_000


@pytest.mark.parametrize("size", [20, 50])
def test_a_large_honest_team_is_answered_whole_and_takes_few_tests(rng, size):
    team = tuple(f"v{i:02d}" for i in range(size))
    decision, tested = run(DEFENSE, [], 12, rng, team=team)
    assert decision.accepted == team
    assert sum(map(len, tested[1:])) < 1.6 * len(tested[1:])


TWENTY = tuple(f"v{i:02d}" for i in range(20))


def test_twenty_teammates_with_four_attackers(rng):
    bad = {"v03", "v04", "v11", "v17"}
    decision, _ = run(DEFENSE, bad, 9, rng, team=TWENTY)
    assert named(decision) == bad
    assert bad.isdisjoint(decision.accepted)


def test_a_search_among_twenty_teammates_takes_small_subsets(rng):
    _, tested = run(with_settings(inspections=0), {"v03", "v04", "v11", "v17"}, 3, rng, team=TWENTY)
    assert all(len(o.teammates) <= 10 for frame in tested for o in frame)


def test_a_larger_team_tests_first_and_answers_with_what_is_clean(rng):
    """Where that fails and the time is up, with whom it trusts; a small team answers first."""
    known, _ = run(with_settings(inspections=0), {"v00"}, 1, rng, team=TWENTY)
    doubtful = {name for name, p in known.suspicion.items() if p > 0.1}
    assert len(doubtful) > 4
    for bad in (set(), doubtful):
        decision, tested = run(DEFENSE, bad, 1, rng, known.state, team=TWENTY, most=1)
        (subset,) = [set(o.teammates) for o in tested[0]]
        assert subset & doubtful
        assert subset - doubtful <= set(known.state["trusted"])
        assert decision.source is (Source.TRUSTED if bad else Source.CONSENSUS)
        assert set(decision.accepted) == (set(known.state["trusted"]) if bad else subset)
    small, _ = run(DEFENSE, ["car-3"], 1, rng)
    _, tested = run(DEFENSE, ["car-3"], 1, rng, small.state, most=1)
    assert set(tested[0][0].teammates) <= set(small.state["trusted"])


def test_as_many_are_hijacked_in_a_large_team_as_in_one_of_ten(rng):
    """Nothing is tested: what is suspected comes from hijacks alone."""

    def attacked(size):
        team = tuple(f"v{i:02d}" for i in range(size))
        state = DEFENSE.initial_state(team)
        weights = [1.0, *[0.0] * (len(state["posterior"]["weights"]) - 1)]
        benign = {"posterior": {**state["posterior"], "weights": weights}, "memory": {**state["memory"], "frame": 1}}
        decision, _ = run(DEFENSE, [], 1, rng, {**state, **benign}, team=team, most=0)
        return 1.0 - decision.state["posterior"]["weights"][0]

    three, six, ten, fifty = (attacked(size) for size in (3, 6, HIJACKED_OF, 50))
    assert six == pytest.approx(2 * three, rel=0.02)
    assert (ten, fifty) == pytest.approx((10 / 6 * six, ten), rel=0.2)  # blocks are an approximation


@pytest.mark.parametrize(
    "settings",
    [
        {"attack_prior": 0.0},
        {"attacker_prior": 1.0},
        {"hijack": 0.6},
        {"naming_bound": 1.0},
        {"naming_bound": 0.4},
        {"first_budget": 0},
        {"budget": 0},
        {"consensus_threshold": 0.0},
    ],
)
def test_settings_out_of_range(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        GroupTestingSettings(**settings)


def test_a_single_teammate_is_tested_only_while_that_is_worth_a_pass(rng):
    _, honest = run(with_settings(inspections=0), [], 8, rng, team=("car-2",))
    assert [len(outcomes) for outcomes in honest] == [1] * 8
    _, attacked = run(with_settings(inspections=0), ["car-2"], 8, rng, team=("car-2",))
    assert [len(outcomes) for outcomes in attacked[3:]] == [0] * 5


def test_outcomes_without_boxes_tell_nothing(rng):
    def bare(subset, attackers, frame):
        full = outcome(subset, attackers, frame)
        return Outcome(full.teammates, full.jaccard_index, full.verdict, None, SEEN)

    before = DEFENSE.initial_state(TEAM)["suspicion"]
    decision, tested = run_frame(DEFENSE, DEFENSE.initial_state(TEAM), TEAM, ["car-3"], rng, judge=bare)
    assert tested
    assert decision.suspicion == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("compare_frames", [True, False])
def test_a_team_of_nobody_is_one_too(compare_frames, rng):
    """The last teammate may leave, and others come."""
    defense = with_settings(compare_frames=compare_frames)
    state = defense.initial_state(["car-2"])
    for team in (["car-2"], [], [], ["car-2", "car-3"], ["car-2", "car-3"]):
        state = defense.change_team(state, team)
        decision, _ = run_frame(defense, state, team, [], rng)
        state = json.loads(json.dumps(decision.state, allow_nan=False))
    assert decision.accepted == ("car-2", "car-3")
    assert decision.suspicion == pytest.approx(dict.fromkeys(team, 0.05), abs=0.05)


def test_a_frame_without_a_test_does_not_forget_that_the_ego_flickers(rng):
    """Where it does, it takes twice the lies to be named."""
    known, _ = run(DEFENSE, [], 3, rng)
    state = json.loads(json.dumps(known.state))
    state["memory"]["steadiness"] |= {"boxes": 400.0, "changes": 200.0}
    state["memory"]["lies"]["levels"] = {"car-3": {"ghost": [RULES["ghost"].names, RULES["ghost"].names]}}
    state["posterior"] = run(DEFENSE, ["car-3"], 3, rng)[0].state["posterior"]
    assert run(DEFENSE, [], 1, rng, state, most=0)[0].named == ()
    state["memory"]["steadiness"] |= {"changes": 4.0}
    assert run(DEFENSE, [], 1, rng, state, most=0)[0].named == ("car-3",)
