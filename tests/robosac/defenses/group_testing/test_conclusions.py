"""Who is blamed for a false object, and named, and who is not."""

from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.defenses import EGO, Outcome
from robosac.defenses.group_testing.conclusions import conclude
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import RULES, Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.posterior import Posterior
from robosac.defenses.group_testing.steadiness import Steadiness
from tests.robosac.defenses.group_testing.conversing import TEAM
from tests.robosac.defenses.group_testing.one_place import (
    ASIDE,
    CAR,
    DRIVING_MOVED,
    DRIVING_UNFOUNDED,
    DRIVING_VEILED,
    ERASED,
    GHOST,
    LIAR,
    MODEL,
    MOVED,
    NEAR,
    NO,
    PLACE,
    SEEN,
    UNSAID,
    VEILED,
    YES,
    World,
    nothing,
    seen_by,
    there,
    with_liar,
)
from tests.robosac.testifying import saying


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
    assert any(kind in item["kinds"] for item in audited)
    for item in audited:
        assert set(item["kinds"]) <= {kind, "straying", "late"}
        assert item["places"][0] == pytest.approx(PLACE + [world.speed * item["frame"], 0.0], abs=2.0)


@pytest.mark.parametrize("kind", ["moved", "veiled", "gone"])
def test_who_is_wrong_about_one_thing_only_is_left_out_and_not_named(kind):
    met = {"moved": MOVED, "veiled": VEILED, "gone": UNSAID}[kind].play(60)
    assert not any(decision.named for decision, _ in met)
    assert any(
        kind in item["kinds"] for item in met[-1][0].state["memory"]["evidence"][LIAR] if item["test"] == "objects"
    )
    assert any(LIAR not in decision.accepted for decision, _ in met)


def test_without_testimony_a_lie_names_nobody():
    """A single object is below what whole fusions show."""
    world = World({}, GHOST.shows)
    world.testimony = None
    met = world.play(10)
    assert {name for decision, _ in met for name in decision.named} == set()
    assert all(decision.objects is None and decision.contradicted == () for decision, _ in met)


def test_a_false_box_that_nobody_brings_is_blamed_on_nobody():
    """The detector itself shows it, with and without each of them; after a while nobody is asked any more."""
    met = World({EGO: NO, "car-2": NO, "rsu": NO}, lambda subset: CAR).play(12)
    assert all(decision.named == () for decision, _ in met)
    assert max(met[-1][0].suspicion.values()) < 0.5
    assert set(met[-1][0].accepted) == set(TEAM)
    assert min(len(tested) for _, tested in met[1:]) < len(met[0][1])


def test_two_that_say_again_and_again_that_another_moves_a_vehicle_do_not_get_it_named():
    """A third one that says so does."""
    driving = dict.fromkeys(("car-2", "car-3"), YES)
    two, three = (World(said, with_liar(ASIDE, NEAR), speed=1.0) for said in (driving, {**driving, "rsu": YES}))
    assert not any(decision.named for decision, _ in two.play(20))
    assert any(LIAR in decision.named for decision, _ in three.play(20))


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


def concluded(world, answer, *subsets, named=()):
    """What is found out by these fusions."""
    found = Findings(knowledge(), Lies(), tuple(TEAM), named)
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


def suspected(world, answer):
    """The suspicion of one of an answer, before and after it was decoded in a frame."""
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    before = found.known.suspicion()[answer[0]]
    found.learn(world.judge(answer, None, 0))
    conclude(found, answer)
    return before, found.known.suspicion()[answer[0]]


@pytest.mark.parametrize(("aside", "nobodys"), [(0.0, True), (2.0, True), (4.0, False), (None, False)])
def test_what_is_wrong_in_what_the_ego_sees_alone_is_nobodys_doing(aside, nobodys):
    """A box that all deny is no reason not to clear those fused, nor to leave them out, if the ego shows it alone."""
    world = World(dict.fromkeys(("car-2", "car-3", "rsu"), NO), lambda _: CAR)
    if aside is not None:
        world.alone = np.vstack([SEEN, CAR + [aside, 0, 0, 0, 0, 0]])
        world.testimony = saying(
            {
                name: [(*PLACE + [x, 0.0], NO if name in ("car-2", "car-3", "rsu") else 0.0) for x in (0.0, aside)]
                for name in (EGO, *TEAM)
            }
        )
    before, after = suspected(world, ("car-2", "rsu"))
    assert (after < before) == nobodys
    assert bool(concluded(world, ("car-2", "rsu")).lies_in(("car-2", "rsu"))) != nobodys


@pytest.mark.parametrize("kind", MODEL.kinds)
def test_whoever_is_fused_where_nothing_is_wrong_is_cleared_of_every_kind_of_attack(kind):
    """Also where the ego is steady, and by whatever its suspicion came."""
    world, answer = World({}, lambda _: SEEN), ("car-2", "rsu")
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    assert found.known.memory.steadiness.calm == 1.0
    speaks = np.zeros(CLEAN + CELLS * len(MODEL.kinds))
    first = CLEAN + CELLS * MODEL.kinds.index(kind)
    speaks[first : first + CELLS] = 6.0
    found.known.posterior.update(*found.known.rows([(), ("rsu",)]), speaks)
    before = found.known.suspicion()["rsu"]
    found.learn(world.judge(answer, None, 0))
    conclude(found, answer)
    after = found.known.suspicion()["rsu"]
    assert np.log(before / (1 - before)) - np.log(after / (1 - after)) > 1.0


def test_a_hole_that_nothing_fills_keeps_nobody_from_being_cleared():
    before, after = suspected(World({"car-2": YES, "car-3": YES}, nothing), ("rsu", "car-5"))
    assert after < before


@pytest.mark.parametrize(("says", "cleared"), [(0.0, True), (NO, True), (4.0, False)])
@pytest.mark.parametrize("others", [3, 2])
def test_where_something_is_wrong_that_one_has_no_part_in_it_is_cleared(says, cleared, others):
    """A ghost stays without it, and its own message does not vouch for that; beside few others that tells nothing."""
    world = World({EGO: -2.0, "car-2": NO, "car-3": NO, "rsu": NO, "car-5": NO, LIAR: says}, lambda _: CAR)
    without = ("car-2", "car-3", "rsu")[:others]
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    before = found.known.suspicion()[LIAR]
    for subset in (tuple(name for name in TEAM if name in (*without, LIAR)), without):
        found.learn(world.judge(subset, None, 0))
    conclude(found, without)
    assert found.lies_in(without)
    assert found.lies.levels == {}
    fallen = before - found.known.suspicion()[LIAR]
    assert fallen == pytest.approx(0.0, abs=1e-9) if not cleared or others < 3 else fallen > 0.01


def test_whoever_tells_a_lie_is_not_cleared_by_another_one_that_it_has_no_part_in():
    """It puts one of two ghosts right to leave it out."""
    elsewhere = CAR - [25.0, 0, 0, 0, 0, 0]
    shows = with_liar(np.vstack([CAR, elsewhere]), elsewhere)
    denied = [(*PLACE, NO), (*elsewhere[0, :2], NO)]
    world = World({}, shows)
    world.testimony = saying({EGO: [], **{name: [] if name == LIAR else denied for name in TEAM}})
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    before = found.known.suspicion()[LIAR]
    without = tuple(name for name in TEAM if name != LIAR)
    for subset in (tuple(TEAM), without):
        found.learn(world.judge(subset, None, 0))
    more = Findings(knowledge(), Lies(), tuple(TEAM), ())
    for subset in (tuple(TEAM), without, ("car-2", "car-3", LIAR, "rsu"), ("car-2", "car-3", "rsu")):
        boxes = np.vstack([SEEN, elsewhere if subset == without else shows((LIAR,))])
        more.learn(replace(world.judge(subset, None, 0), boxes=boxes))
    for each in (found, more):
        conclude(each, without)
        assert each.lies.levels.keys() == {LIAR}
        assert each.known.suspicion()[LIAR] > before
    assert more.known.suspicion()[LIAR] == pytest.approx(found.known.suspicion()[LIAR], abs=0.05)


def test_a_hole_may_be_somebodys_doing_though_the_ego_misses_the_vehicle_too():
    assert [lie.kind for lie in concluded(ERASED, ("car-2", "car-3", LIAR)).lies_in(("car-2", "car-3", LIAR))] == [
        "gone"
    ]


@pytest.mark.parametrize(("score", "asked"), [(0.45, False), (0.55, True)])
def test_nobody_is_asked_about_a_faint_box(score, asked):
    """Nobody is to blame for one, so there is nothing to find out."""
    faint = CAR * [1, 1, 1, 1, 1, 0] + [0, 0, 0, 0, 0, score]
    world = World(dict.fromkeys(("car-2", "car-3", "rsu"), NO), with_liar(faint, CAR[:0]))
    assert bool(concluded(world, (*TEAM,)).lies_in((*TEAM,))) == asked


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


@pytest.mark.parametrize("world", [DRIVING_VEILED, DRIVING_UNFOUNDED])
def test_who_denies_its_own_ghosts_or_says_nothing_of_them_is_named_too(world):
    met = world.play(12)
    assert {name for decision, _ in met for name in decision.named} == {LIAR}
    items = [item for item in met[-1][0].state["memory"]["evidence"][LIAR] if item["test"] == "objects"]
    assert "veiled" in {kind for item in items for kind in item["kinds"]} <= {"veiled", "late"}


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


@pytest.mark.parametrize("kind", ["conflict", "unseen"])
@pytest.mark.parametrize(("calm", "times"), [(1.0, RULES["conflict"].times), (0.1, 1)])
def test_a_conflict_over_one_place_counts_once_beside_an_ego_that_flickers(calm, times, kind, monkeypatch):
    monkeypatch.setattr(Steadiness, "calm", calm)
    alone_with_it = World({"car-2": YES, "car-3": YES, "rsu": YES, LIAR: NO}, lambda _: CAR)
    empty = kind == "unseen"
    alone_with_it.testimony = replace(alone_with_it.testimony, empty=lambda _, at: np.full(len(at), empty))
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    counted = []
    for frame in range(5):
        found.known.memory.frame = frame
        found.learn(alone_with_it.judge(tuple(TEAM), None, frame))
        before = found.lies.levels.get(LIAR, {}).get(kind, (0.0, 0.0))[0]
        conclude(found, tuple(TEAM))
        counted.append(found.lies.levels.get(LIAR, {}).get(kind, (0.0, 0.0))[0] > before)
    assert counted == [True] * times + [False] * (5 - times)


def seeing(elsewhere, empty):
    """What all say where one denies two vehicles that all others see, and sees so many where they see that none is."""
    denied = [(*PLACE, NO), (*SEEN[0, :2], NO)]
    own = denied + [(-20.0 + 8.0 * i, 2.0, YES) for i in range(elsewhere)]
    others = [(x, y, -value) for x, y, value in own]
    testimony = saying({name: own if name == LIAR else others for name in (EGO, *TEAM)})
    return replace(testimony, empty=lambda name, places: np.full(len(places), empty and name == LIAR))


@pytest.mark.parametrize(
    ("elsewhere", "empty", "kind"),
    [(0, True, "unseen"), (2, True, "unseen"), (3, True, "conflict"), (0, False, "conflict")],
)
def test_who_denies_what_others_see_where_it_shows_nothing_may_be_blind_and_is_not_named(elsewhere, empty, kind):
    found = Findings(knowledge(), Lies(), tuple(TEAM), ())
    told = {"testimony": seeing(elsewhere, empty), "alone": SEEN}
    for frame in range(8):
        found.known.memory.frame = frame
        found.learn(
            Outcome(tuple(TEAM), 0.9, Verdict.CONSENSUS, np.vstack([SEEN, CAR]), SEEN, np.eye(4), frame, **told)
        )
        conclude(found, tuple(TEAM))
    assert set(found.lies.levels[LIAR]) == {kind}
    found.lies.effects[LIAR] = frame
    assert (found.lies.guilt(LIAR, frame) > 0) == (kind == "conflict")
    assert found.known.suspicion()[LIAR] > 0.5


@pytest.mark.parametrize(("named", "kind"), [((LIAR, "car-5"), "late"), ((LIAR, "car-5", "rsu"), "moved")])
def test_two_may_lie_together_as_long_as_three_others_than_the_suspect_are_heard(named, kind):
    two = World({"car-2": YES, "car-3": YES}, with_liar(ASIDE, NEAR))
    fused = tuple(name for name in TEAM if name == LIAR or name not in named)
    without = tuple(name for name in fused if name != LIAR)
    parts = [tuple(name for name in fused if name != other) for other in fused]
    assert without in parts
    assert set(concluded(two, fused, *parts, named=named).lies.levels[LIAR]) == {kind}


@pytest.mark.parametrize(
    ("said", "kind"),
    [
        ({"car-2": YES, "car-3": YES}, "late"),
        ({EGO: YES, "car-2": YES}, "gone"),
        ({"car-2": YES, "car-3": YES, "rsu": YES}, "gone"),
    ],
)
def test_two_may_say_together_that_the_last_honest_one_takes_a_vehicle_away(said, kind):
    others = ("car-2", "car-3", "rsu", "car-5")
    framed = World(said | {LIAR: NO}, with_liar(CAR[:0], CAR))
    assert set(concluded(framed, (*others, LIAR), others).lies.levels[LIAR]) == {kind}
