"""Sessions in which one object is false: who is asked, who is blamed, and how each box stands."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Standing, Verdict
from robosac.defenses import EGO, Outcome
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.conclusions import conclude
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.inspection import Inspection
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import RULES, Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.objects import Hearing, Shown
from robosac.defenses.group_testing.posterior import Posterior
from robosac.defenses.group_testing.standing import judge
from robosac.defenses.group_testing.steadiness import Steadiness
from tests.robosac.defenses.group_testing.conversing import TEAM, make_model, run_frame
from tests.robosac.testifying import saying

MODEL = make_model().with_lies
DEFENSE = GroupTesting(MODEL)
SEEN = np.array([[x, y, 4.5, 1.9, 0.0, 0.9] for x in (-22.4, -7.4, 7.6, 22.6) for y in (-12.3, 12.7)])
"""What everybody sees."""
PLACE = np.array([10.4, 2.3])
CAR = np.array([[*PLACE, 4.5, 1.9, 0.0, 0.9]])
YES, NO = 5.5, -7.0
LIAR = "car-4"


class World:
    """Cars that everybody sees, and one place over which they differ.

    Parameters
    ----------
    said : mapping of agent to float
        L of the place, the ego's under "".
    shows : callable
        A subset -> the boxes (n, 6) that its fusion shows there.
    speed : float
        At which all of them drive, metres a frame.
    """

    def __init__(self, said, shows, speed=0.0):
        known = {name: [(x, y, YES) for x, y in SEEN[:, :2]] for name in (EGO, *TEAM)}
        for name, value in said.items():
            known[name].append((*PLACE, value))
        self.testimony = saying(known)
        self.shows = shows
        self.speed = speed

    def judge(self, subset, _, frame):
        boxes = np.vstack([SEEN, self.shows(subset)])
        told = {"testimony": self.testimony, "alone": SEEN}
        pose = np.eye(4)
        pose[0, 3] = self.speed * frame
        return Outcome(subset, 0.93, Verdict.CONSENSUS, boxes, SEEN, pose, frame, **told)

    def play(self, frames, defense=DEFENSE, quiet=0):
        """Decisions, and the boxes of each subset decoded, of frames after some in which nobody lies."""
        state = HONEST.play(quiet, defense)[-1][0].state if quiet else defense.initial_state(TEAM)
        rng, met = np.random.default_rng(0), []
        for _ in range(frames):
            decision, tested = run_frame(defense, state, TEAM, [], rng, judge=self.judge)
            state = json.loads(json.dumps(decision.state))
            met.append((decision, {o.teammates: o.boxes for o in tested}))
        return met


def nothing(subset):
    return CAR[:0]


def with_liar(shown, otherwise):
    """What a fusion shows with the liar, and without it."""
    return lambda subset: shown if LIAR in subset else otherwise


def seen_by(*names):
    """A fusion with any of them shows the car."""
    return lambda subset: CAR if set(names) & set(subset) else CAR[:0]


def erased(subset):
    return CAR[:0] if LIAR in subset else seen_by("car-2", "car-3", "rsu")(subset)


HONEST = World({}, nothing)
GHOST = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: YES}, with_liar(CAR, CAR[:0]))
ERASED = World({"car-2": YES, "car-3": YES, "rsu": YES, LIAR: NO}, erased)
NEAR, ASIDE = CAR + [0, 0.1, 0, 0, 0, 0], CAR + [0, 1.6, 0, 0, 0, 0]
MOVED = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(ASIDE, NEAR))
DRIVING_MOVED = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(ASIDE, NEAR), speed=1.0)
VEILED = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: NO}, with_liar(CAR, CAR[:0]))
DRIVING_VEILED = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: NO}, with_liar(CAR, CAR[:0]), speed=1.0)
UNSAID = World({"car-2": YES, "car-3": YES, "rsu": YES}, erased)


def there(decision, tested, boxes):
    """Judged boxes around the place, with their rows."""
    rows = [(judged, tested[judged.subset][judged.index]) for judged in boxes]
    return [(judged, row) for judged, row in rows if np.hypot(*(row[:2] - PLACE)) < 4.0]


@pytest.mark.parametrize(("world", "kind"), [(GHOST, "ghost"), (ERASED, "gone"), (DRIVING_MOVED, "moved")])
def test_who_lies_about_an_object_is_named_and_nobody_else(world, kind):
    met = world.play(10)
    assert {name for decision, _ in met for name in decision.named} == {LIAR}
    last, _ = met[-1]
    assert set(last.accepted) == set(TEAM) - {LIAR}
    assert max(p for name, p in last.suspicion.items() if name != LIAR) < 0.5
    items = [item for item in last.state["memory"]["evidence"][LIAR] if item["test"] == "objects"]
    assert all(item["log_likelihood_ratio"] > 0 for item in items)
    assert all(item["kinds"] or item["conflicts"] for item in items)
    audited = [item for item in items if item["kinds"]]
    assert audited
    for item in audited:
        assert set(item["kinds"]) == {kind}
        assert item["places"][0] == pytest.approx(PLACE + [world.speed * item["frame"], 0.0], abs=2.0)


@pytest.mark.parametrize("kind", ["moved", "veiled", "gone"])
def test_who_is_wrong_about_one_thing_only_is_left_out_and_not_named(kind):
    met = {"moved": MOVED, "veiled": VEILED, "gone": UNSAID}[kind].play(60)
    assert not any(decision.named for decision, _ in met)
    assert any(
        kind in item["kinds"] for item in met[-1][0].state["memory"]["evidence"][LIAR] if item["test"] == "objects"
    )
    assert any(LIAR not in decision.accepted for decision, _ in met)


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


def test_without_testimony_a_lie_names_nobody():
    """A single object is below what whole fusions show."""
    world = World({}, GHOST.shows)
    world.testimony = None
    met = world.play(10)
    assert {name for decision, _ in met for name in decision.named} == set()
    assert all(decision.objects is None and decision.contradicted == () for decision, _ in met)


def test_a_ghost_is_in_no_answer():
    for decision, tested in GHOST.play(6, quiet=6):
        assert there(decision, tested, decision.objects) == []
        assert len(decision.objects) == len(SEEN)


def test_with_the_liar_in_the_answer_a_ghost_is_contradicted():
    decision, tested = GHOST.play(1, GroupTesting(MODEL, GroupTestingSettings(inspections=0)), quiet=6)[0]
    assert LIAR in decision.accepted
    ((ghost, _),) = there(decision, tested, decision.contradicted)
    assert ghost.support.status is Standing.CONTRADICTED
    assert (ghost.support.witnesses, set(ghost.support.deniers)) == ((LIAR,), {EGO, "car-2", "car-3"})
    assert there(decision, tested, decision.objects) == []


def test_a_ghost_in_the_answer_is_audited():
    """The answer is decoded without whoever vouches for it, at once."""
    decision, tested = GHOST.play(1, quiet=6)[0]
    whole, without, *_ = tested
    assert set(whole) == set(TEAM)
    assert without == tuple(name for name in whole if name != LIAR)
    assert decision.state["memory"]["lies"]["levels"].keys() == {LIAR}


TRUE = {ERASED: CAR[0], MOVED: NEAR[0]}


@pytest.mark.parametrize("world", TRUE)
def test_what_a_liar_removes_or_moves_is_answered_where_it_is(world):
    for decision, tested in world.play(5, quiet=6):
        ((_, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, TRUE[world])
        assert len(decision.objects) == len(SEEN) + 1
        assert decision.contradicted == ()


@pytest.mark.parametrize(("world", "inspections"), [(ERASED, 1), (MOVED, 4)])
def test_with_the_liar_in_the_answer_a_box_is_repaired(world, inspections):
    """Taken from a fusion without it, although there was no time to find out who it is."""
    decision, tested = world.play(1, GroupTesting(MODEL, GroupTestingSettings(inspections=inspections)), quiet=6)[0]
    assert LIAR in decision.accepted
    ((judged, row),) = there(decision, tested, decision.objects)
    assert judged.support.status is Standing.REPAIRED
    assert LIAR not in judged.subset
    np.testing.assert_array_equal(row, TRUE[world])


@pytest.mark.parametrize(
    ("said", "status"),
    [
        ({EGO: YES, "car-2": NO}, Standing.DISPUTED),
        ({EGO: 3.5, "car-2": -1.5, "rsu": YES}, Standing.DISPUTED),
        ({EGO: 3.5, "rsu": YES}, Standing.CONFIRMED),
        ({"car-2": YES, "rsu": YES}, Standing.CONFIRMED),
        ({"car-2": YES, "rsu": 2.7, "car-3": 0.5}, Standing.CONFIRMED),
        ({"car-2": YES, "rsu": 2.7}, Standing.SINGLE_WITNESS),
        ({"car-2": YES, "rsu": 2.0, "car-3": 2.0}, Standing.SINGLE_WITNESS),
        ({"car-2": YES}, Standing.SINGLE_WITNESS),
        ({}, Standing.SINGLE_WITNESS),
        ({"car-2": YES, "rsu": NO}, Standing.DISPUTED),
        ({"car-2": YES, "car-3": YES, "rsu": NO}, Standing.DISPUTED),
        ({EGO: -2.0, "car-2": YES, "car-3": YES}, Standing.DISPUTED),
        ({EGO: -0.5, "rsu": -0.6, "car-2": YES, "car-3": YES}, Standing.DISPUTED),
        ({EGO: -2.0, "car-2": YES}, Standing.DISPUTED),
        ({EGO: -0.5, "car-2": YES, "car-3": YES}, Standing.CONFIRMED),
        ({EGO: YES, "car-2": -2.0}, Standing.CONFIRMED),
        ({"car-2": NO, "rsu": NO}, Standing.DISPUTED),
        ({EGO: -2.0, "car-2": NO, "rsu": NO}, Standing.CONTRADICTED),
        ({"car-2": NO, "car-3": NO, "rsu": NO}, Standing.CONTRADICTED),
    ],
)
def test_a_box_stands_on_what_is_said_of_it(said, status):
    decision, tested = World(said, lambda _: CAR).play(1)[0]
    boxes = decision.contradicted if status is Standing.CONTRADICTED else decision.objects
    ((judged, _),) = there(decision, tested, boxes)
    assert judged.support.status is status
    assert set(judged.support.witnesses) == {name for name, value in said.items() if value >= 3.0}
    against = status in (Standing.DISPUTED, Standing.CONTRADICTED)
    least = max(-1.0, min(said.values())) if against else NO
    assert set(judged.support.deniers) == {name for name, value in said.items() if value <= least}
    everywhere = [other.support for other in decision.objects if other is not judged]
    assert {each.status for each in everywhere} == {Standing.CONFIRMED}
    assert all(set(each.witnesses) == {EGO, *TEAM} for each in everywhere)


def test_where_only_the_ego_is_heard_its_word_is_enough():
    testimony = World({EGO: YES, "car-2": NO}, lambda _: CAR).testimony
    shown = Shown(("car-2",), np.vstack([SEEN, CAR]), Hearing(testimony, TEAM))
    objects, contradicted = judge(shown, [shown])
    assert {box.support.status for box in objects} == {Standing.CONFIRMED}
    assert contradicted == ()


def test_a_false_box_that_nobody_brings_is_blamed_on_nobody():
    """The detector itself shows it, with and without each of them; after a while nobody is asked any more."""
    met = World({EGO: NO, "car-2": NO, "rsu": NO}, lambda subset: CAR).play(12)
    assert all(decision.named == () for decision, _ in met)
    assert max(met[-1][0].suspicion.values()) < 0.5
    assert set(met[-1][0].accepted) == set(TEAM)
    assert min(len(tested) for _, tested in met[1:]) < len(met[0][1])


def test_one_who_denies_what_another_sees_is_believed_no_more_than_it():
    """One word against one: nobody is named, and the box stays."""
    world = World({"car-2": YES, "rsu": NO}, seen_by("car-2"))
    for decision, tested in world.play(10):
        assert decision.named == ()
        assert decision.contradicted == ()
        if "car-2" in decision.accepted:
            assert there(decision, tested, decision.objects)


@pytest.mark.parametrize("victims", [("rsu",), ("rsu", "car-5")])
def test_two_that_deny_together_what_others_see_frame_nobody(victims):
    """Two words against one or two: nobody is suspected, and the box stays, as one that is disputed."""
    world = World({"car-2": NO, "car-3": NO, **dict.fromkeys(victims, YES)}, seen_by(*victims))
    for decision, tested in world.play(12):
        assert decision.named == ()
        assert decision.contradicted == ()
        assert set(victims) <= set(decision.accepted)
        ((judged, _),) = there(decision, tested, decision.objects)
        assert judged.support.status is Standing.DISPUTED
    assert max(decision.suspicion[name] for name in victims) < 0.1


def test_two_that_say_again_and_again_that_another_moves_a_vehicle_do_not_get_it_named():
    """A third one that says so does."""
    driving = dict.fromkeys(("car-2", "car-3"), YES)
    two, three = (World(said, with_liar(ASIDE, NEAR), speed=1.0) for said in (driving, {**driving, "rsu": YES}))
    assert not any(decision.named for decision, _ in two.play(20))
    assert any(LIAR in decision.named for decision, _ in three.play(20))


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
    assert (LIAR in later[-1][0].named) == (inspections > 1)


ALONE = World({"car-2": YES, LIAR: NO}, lambda subset: CAR[:0] if LIAR in subset else seen_by("car-2")(subset))


def test_what_one_sees_and_one_takes_away_is_shown_and_nobody_is_named():
    """One word against one: whoever takes it away is left out, but may be right."""
    met = ALONE.play(10)
    assert {name for decision, _ in met for name in decision.named} == set()
    assert all(there(decision, tested, decision.objects) for decision, tested in met[2:])
    last, _ = met[-1]
    assert LIAR not in last.accepted
    assert "car-2" in last.accepted


def test_everybody_is_left_out_once_although_nothing_is_wrong():
    met = HONEST.play(4)
    left_out = {name for _, tested in met for subset in tested if len(subset) == 4 for name in set(TEAM) - set(subset)}
    assert left_out == set(TEAM)


def test_who_moves_all_boxes_a_little_is_left_out():
    """Each box is nearly in its place, and overlaps what it was."""
    world = World({}, nothing)
    world.judge = shifted(world.judge, 0.4)
    met = world.play(8)
    last, _ = met[-1]
    assert LIAR not in last.accepted
    assert all(p < 0.5 for name, p in last.suspicion.items() if name != LIAR)
    assert {name for decision, _ in met for name in decision.named} == set()


def shifted(judge, aside):
    """The same outcomes, with boxes moved across themselves where the liar is fused."""

    def moved(subset, *more):
        outcome = judge(subset, *more)
        off = np.array([0, aside, 0, 0, 0, 0]) if LIAR in subset else 0.0
        return replace(outcome, boxes=outcome.boxes + off)

    return moved


def knowledge():
    return Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), Memory())


def concluded(world, answer, *subsets):
    """What is found out by these fusions."""
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    for subset in (answer, *subsets):
        found.learn(world.judge(subset, None, 0))
    conclude(found, answer)
    return found


def test_a_hole_is_left_alone_only_after_those_who_see_a_vehicle_there_were_asked():
    unseen = World({"car-2": YES, "car-3": YES}, nothing)
    assert concluded(unseen, ("rsu", "car-5")).lies.quiet == []
    assert concluded(unseen, ("car-2", "car-3", "rsu")).lies.quiet == []
    assert len(concluded(unseen, ("car-2", "car-3", "rsu"), ("car-2", "car-3")).lies.quiet) == 1


def test_beside_few_others_nobody_is_to_blame_for_what_is_gone():
    few, more = ("car-2", "car-3"), ("car-2", "car-3", "rsu")
    assert "gone" not in concluded(ERASED, (*few, LIAR), few).lies.levels.get(LIAR, {})
    assert "gone" in concluded(ERASED, (*more, LIAR), more).lies.levels[LIAR]


@pytest.mark.parametrize(("seen_by_others", "unsteady"), [(True, False), (False, True)])
def test_who_flickers_where_others_see_vehicles_is_not_unsteady(seen_by_others, unsteady):
    knowing = {EGO, *TEAM} if seen_by_others else {LIAR}
    testimony = saying(
        {name: [(x, y, YES) for x, y in SEEN[:, :2]] if name in knowing else [] for name in (EGO, *TEAM)}
    )
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    for frame, boxes in enumerate((SEEN, SEEN[:0])):
        told = {"testimony": testimony, "alone": SEEN}
        outcome = Outcome((LIAR,), 0.93, Verdict.CONSENSUS, boxes, SEEN, np.eye(4), frame, **told)
        evidence = Evidence(found.known)
        evidence.learn(outcome, found.learn(outcome))
        evidence.compare_singles()
        found.known.memory.shown, found.known.memory.shown_in = evidence.shown, frame
    assert (LIAR in found.known.memory.steadiness.levels) == unsteady


def test_a_ghost_is_blamed_beside_few_others_too():
    assert "ghost" in concluded(GHOST, ("car-2", "car-3", LIAR), ("car-2", "car-3")).lies.levels[LIAR]


def test_who_denies_its_own_ghosts_is_named_too():
    met = DRIVING_VEILED.play(12)
    assert {name for decision, _ in met for name in decision.named} == {LIAR}
    items = [item for item in met[-1][0].state["memory"]["evidence"][LIAR] if item["test"] == "objects"]
    assert {kind for item in items for kind in item["kinds"]} == {"veiled"}


@pytest.mark.parametrize("denied", [{"": NO}, {"car-2": NO, "car-3": NO, "": -4.0}])
def test_two_that_vouch_for_each_others_ghost_are_both_named(denied):
    """Leaving out one of them changes nothing: the other one shows it as well."""
    liars = {LIAR, "rsu"}
    world = World({**denied, **dict.fromkeys(liars, YES)}, seen_by(*liars))
    met = world.play(10)
    assert {name for decision, _ in met for name in decision.named} == liars
    for decision, tested in met:
        assert there(decision, tested, decision.objects) == []
    assert set(met[-1][0].accepted) == set(TEAM) - liars


def test_who_moves_a_vehicle_along_itself_may_be_late_and_is_not_named():
    behind = CAR - [2.0, 0, 0, 0, 0, 0]
    met = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(behind, NEAR)).play(12)
    assert {name for decision, _ in met for name in decision.named} == set()
    last, _ = met[-1]
    assert LIAR not in last.accepted
    assert last.suspicion[LIAR] > 0.5


@pytest.mark.parametrize(("calm", "times"), [(1.0, RULES["conflict"].times), (0.1, 1)])
def test_a_conflict_over_one_place_counts_once_beside_an_ego_that_flickers(calm, times, monkeypatch):
    monkeypatch.setattr(Steadiness, "calm", calm)
    alone_with_it = World({"car-2": YES, "car-3": YES, "rsu": YES, LIAR: NO}, lambda _: CAR)
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    counted = []
    for frame in range(5):
        found.known.memory.frame = frame
        found.learn(alone_with_it.judge(tuple(TEAM), None, frame))
        before = found.lies.levels.get(LIAR, {}).get("conflict", (0.0, 0.0))[0]
        conclude(found, tuple(TEAM))
        counted.append(found.lies.levels.get(LIAR, {}).get("conflict", (0.0, 0.0))[0] > before)
    assert counted == [True] * times + [False] * (5 - times)
