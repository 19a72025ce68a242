"""Who is asked about the objects of a frame, how often, and what is told of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.geometry import followed
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.inspection import Inspection
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import TEAM, make_model, run_frame
from tests.robosac.defenses.group_testing.one_place import (
    CAR,
    DEFENSE,
    ERASED,
    GHOST,
    HONEST,
    LIAR,
    MODEL,
    MOVED,
    NO,
    PLACE,
    SEEN,
    VEILED,
    YES,
    World,
    seen_by,
    there,
    with_liar,
)


@pytest.mark.parametrize(("world", "done"), [(GHOST, "invented"), (ERASED, "removed"), (MOVED, "displaced")])
def test_what_is_wrong_by_somebodys_fault_is_told_with_its_place(world, done):
    decision, tested = world.play(1, quiet=6)[0]
    found = [each for each in decision.differences if each.test == "objects"]
    assert found
    for each in found:
        assert set(each.teammates) - set(each.beside) == {LIAR}
        assert {each.teammates, each.beside} <= set(tested)
        places = {kind: where for kind, where in each.places().items() if len(where)}
        assert set(places) == {done}
        np.testing.assert_allclose(places[done], [PLACE], atol=2.0)
    assert HONEST.play(1, quiet=6)[0][0].differences
    assert not [each for each in HONEST.play(1, quiet=6)[0][0].differences if each.test == "objects"]


def test_what_fusions_show_otherwise_than_each_other_is_told():
    """Each fusion beside the ego alone and beside its parts, and beside itself in the frame before."""
    (before, _), (decision, tested) = GHOST.play(2, quiet=6)
    again = [each for each in decision.differences if each.test == "change"]
    assert {each.teammates for each in again} <= set(tested)
    assert all(each.teammates == each.beside for each in again)
    beside_ego = [each for each in before.differences if each.test == "ego"]
    assert beside_ego
    for each in beside_ego:
        assert each.beside == ()
        added = each.places()["added"]
        assert len(added) == (LIAR in each.teammates)
        assert added.tolist() == [PLACE.tolist()] * len(added)
    pairs = [each for each in before.differences if each.test == "pair"]
    assert pairs
    for each in pairs:
        brought = LIAR in each.teammates and LIAR not in each.beside
        assert len(each.places()["added"]) == brought


def test_a_ghost_in_the_answer_is_audited():
    """The answer is decoded without whoever vouches for it, at once."""
    decision, tested = GHOST.play(1, quiet=6)[0]
    whole, without, *_ = tested
    assert set(whole) == set(TEAM)
    assert without == tuple(name for name in whole if name != LIAR)
    assert decision.state["memory"]["lies"]["levels"].keys() == {LIAR}


@pytest.mark.parametrize(("size", "one_by_one"), [(6, True), (8, False)])
def test_those_cleared_of_a_large_team_are_asked_again_together_only(size, one_by_one):
    """Every other frame all that are left out are asked together, in between one of those in doubt."""
    team = tuple(f"v{i}" for i in range(size))
    posterior, answer = Posterior(len(MODEL.kinds), 1e-3, 0.25, team), team[:4]

    def asked(frame):
        found = Findings(Knowledge(MODEL, posterior, Memory(frame=frame)), Lies(), team, ())
        found.hearing = Hearing(HONEST.testimony, ())
        return Inspection(found, keep_contradicted=False).next_test(answer)

    assert asked(2) == team
    assert asked(3) == (team[:5] if one_by_one else None)
    accusing = np.repeat([0.0, 4.7], [CLEAN, CELLS * len(MODEL.kinds)])
    posterior.update(*(np.array([name in of for name in posterior.members]) for of in ((), team[-1:])), accusing)
    assert asked(3) == (team[:5] if one_by_one else (*answer, team[-1]))


@pytest.mark.parametrize(("inspections", "budget"), [(0, 2), (0, 4), (1, 2)])
@pytest.mark.parametrize("world", [GHOST, VEILED, MOVED])
def test_with_few_inspections_those_left_out_are_asked_again_by_what_the_budget_has_left(world, inspections, budget):
    """No fusion tells of a lie that is told no longer: only who is decoded where nothing is wrong is cleared."""
    defense = GroupTesting(MODEL, GroupTestingSettings(inspections=inspections, budget=budget))
    met = HONEST.play(12, defense, quiet=2, before=world)
    assert set(met[-1][0].accepted) == set(TEAM)
    assert all(len(tested) <= budget + inspections for _, tested in met)


@pytest.mark.parametrize("frames", [10, 20, 40])
def test_four_who_were_away_for_long_are_all_back_in_time(frames, rng):
    """While they are away nothing is known of them, so that they may have been hijacked. All are suspected alike."""
    away = GroupTesting(MODEL, GroupTestingSettings(hijack=0.1))
    state = HONEST.play(6)[-1][0].state
    for _ in range(frames):
        state = run_frame(away, state, TEAM[:1], [], rng, judge=HONEST.judge)[0].state
    assert min(state["suspicion"][name] for name in TEAM[1:]) > 0.6
    for _ in range(20):
        decision, tested = run_frame(DEFENSE, state, TEAM, [], rng, judge=HONEST.judge)
        state = json.loads(json.dumps(decision.state))
    assert set(decision.accepted) == set(TEAM)
    assert decision.named == ()
    assert len(tested) == 1


def test_nobody_is_suspected_where_nothing_is_wrong():
    met = World(dict.fromkeys((EGO, *TEAM), YES), lambda _: CAR).play(15)
    last, tested = met[-1]
    assert max(last.suspicion.values()) < 0.1
    assert set(last.accepted) == set(TEAM)
    assert set(last.state["trusted"]) == set(TEAM)
    assert len(tested) == 1


def test_objects_are_judged_only_if_asked_for():
    plain = GroupTesting(make_model(), GroupTestingSettings(judge_objects=False))
    assert (plain.asks_witnesses, DEFENSE.asks_witnesses) == (False, True)


@pytest.mark.parametrize("inspections", [0, 1, 3])
def test_inspections_are_bounded(inspections):
    settings = GroupTestingSettings(inspections=inspections)
    (_, first), *later = GHOST.play(8, GroupTesting(MODEL, settings))
    assert len(first) <= settings.first_budget + inspections
    assert all(len(tested) <= settings.budget + inspections for _, tested in later)
    assert LIAR in later[-1][0].named


@pytest.mark.parametrize("budget", [2, 4])
def test_without_inspections_the_budget_finds_who_lies_in_a_large_team(budget):
    """It stays in the answer, as its boxes are contradicted: nothing else would ever leave it out."""
    large = [*TEAM, *(f"van-{i}" for i in range(9))]
    lied = World({"": NO, LIAR: YES, "car-2": NO, "car-3": NO}, with_liar(CAR, CAR[:0]), team=large)
    defense = GroupTesting(MODEL, GroupTestingSettings(inspections=0, budget=budget))
    met = lied.play(6, defense, quiet=8, before=World({}, lambda _: CAR[:0], team=large))
    assert met[-1][0].named == (LIAR,)
    assert LIAR not in met[-1][0].accepted
    assert all(len(tested) <= budget for _, tested in met)


@pytest.mark.parametrize(
    ("frame", "verdict", "audited"), [(0, "consensus", TEAM), (0, "dissensus", TEAM[:3]), (1, "consensus", TEAM[:3])]
)
def test_in_the_first_frame_the_largest_fusion_in_consensus_is_audited(frame, verdict, audited):
    """It may become the answer once nothing is found wrong."""
    team = tuple(TEAM)
    found = Findings(
        Knowledge(MODEL, Posterior(len(MODEL.kinds), 1e-3, 0.25, team), Memory(frame=frame)), Lies(), team, ()
    )
    inspection = Inspection(found, keep_contradicted=False)
    for subset, said in ((team, verdict), (team[:3], "consensus")):
        inspection.learn(replace(HONEST.judge(subset, None, frame), verdict=Verdict(said)))
    asked = list(inspection._questions(team[:3]))
    assert {subset for subset in asked if len(subset) == len(audited) - 1} == {
        tuple(other for other in audited if other != name) for name in audited
    }


def test_everybody_is_left_out_once_although_nothing_is_wrong():
    met = HONEST.play(4)
    left_out = {name for _, tested in met for subset in tested if len(subset) == 4 for name in set(TEAM) - set(subset)}
    assert left_out == set(TEAM)


@pytest.mark.parametrize("own", [YES, 0.0])
def test_a_vehicle_that_one_other_sees_is_shown_again_once_somebody_makes_it_vanish_that_was_honest_for_long(own):
    """By its own word the vehicle may be there."""
    said = {"car-2": YES, LIAR: own}
    shown, taken = World(said, seen_by("car-2")), World(said, with_liar(CAR[:0], CAR))
    met = taken.play(12, quiet=10, before=shown)
    asked = [set(TEAM) - set(subset) for subset in met[0][1] if len(subset) == len(TEAM) - 1]
    assert {name for (name,) in asked} >= ({LIAR, "car-2"} if own == YES else set(TEAM) - {"car-2"})
    assert all(there(decision, tested, decision.objects) for decision, tested in met)
    assert not any(decision.named for decision, _ in met)
    quiet = shown.play(12, quiet=10, before=shown)
    assert all(len(tested) <= 2 for _, tested in quiet[2:])


@pytest.mark.parametrize(
    ("said", "boxes", "lost"),
    [
        ({"car-2": YES}, CAR[:0], True),
        ({"car-2": 2.0}, CAR[:0], False),
        ({}, CAR[:0], False),
        ({"car-2": YES, "car-3": NO}, CAR[:0], False),
        ({"car-2": YES}, CAR, False),
    ],
    ids=["certain", "unsure", "unseen", "denied", "shown"],
)
def test_a_vehicle_has_vanished_if_somebody_sees_it_and_the_fusion_no_longer_shows_it(said, boxes, lost):
    team = tuple(TEAM)
    found = Findings(Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, team), Memory()), Lies(), team, ())
    found.known.memory.shown = {found.known.key(team): followed(np.vstack([SEEN, CAR]), np.eye(4))}
    found.learn(World(said, lambda _: boxes).judge(team, None, 1))
    assert bool(len(found.lost(team))) == lost
    found.known.memory.shown = {}
    assert not len(found.lost(team))
