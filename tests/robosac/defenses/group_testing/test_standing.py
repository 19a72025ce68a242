"""How the box of a place over which they differ stands, and what is answered there."""

import numpy as np
import pytest

from robosac.answers import Standing, Support
from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.objects import Shown
from robosac.defenses.group_testing.standing import _holes, judge
from tests.robosac.defenses.group_testing.conversing import TEAM
from tests.robosac.defenses.group_testing.one_place import (
    ASIDE,
    CAR,
    ERASED,
    GHOST,
    LIAR,
    MODEL,
    MOVED,
    NEAR,
    NO,
    PLACE,
    SEEN,
    SURE,
    YES,
    World,
    nothing,
    seen_by,
    there,
)
from tests.robosac.testifying import saying


def test_a_ghost_is_in_no_answer():
    for decision, tested in GHOST.play(6, quiet=6):
        assert there(decision, tested, decision.objects) == []
        assert len(decision.objects) == len(SEEN)


def test_with_the_liar_in_the_answer_a_ghost_is_contradicted():
    decision, tested = GHOST.play(1, GroupTesting(MODEL, GroupTestingSettings(inspections=0, budget=1)), quiet=6)[0]
    assert LIAR in decision.accepted
    ((ghost, _),) = there(decision, tested, decision.contradicted)
    assert ghost.support.status is Standing.CONTRADICTED
    assert (ghost.support.witnesses, set(ghost.support.deniers)) == ((LIAR,), {EGO, "car-2", "car-3"})
    assert there(decision, tested, decision.objects) == []


TRUE = {ERASED: CAR[0], MOVED: NEAR[0]}


@pytest.mark.parametrize("world", TRUE)
def test_what_a_liar_removes_or_moves_is_answered_where_it_is(world):
    for decision, tested in world.play(5, quiet=6):
        ((_, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, TRUE[world])
        assert len(decision.objects) == len(SEEN) + 1
        assert decision.contradicted == ()


@pytest.mark.parametrize(
    "instead",
    [[0, 0, 0, 0, 0, -0.65], [3.3, 0, 0, 0, 0, 0], [-2.6, 0, 0, 0, 0, 0], [0, 2.1, 0, 0, 0, 0]],
    ids=["dimmed", "ahead", "behind", "aside"],
)
@pytest.mark.parametrize("own", [NO, YES], ids=["its message says so", "its message tells the truth"])
def test_what_a_liar_dims_or_carries_off_is_answered_where_it_is(instead, own):
    said = {EGO: YES, "car-2": YES, "car-3": YES, LIAR: own, "rsu": 0.0}
    world = World(said, lambda subset: CAR + instead if LIAR in subset else CAR)
    for decision, tested in world.play(4, quiet=6)[1:]:  # passes may be over before it is found out
        ((_, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, CAR[0])
        assert len(decision.objects) == len(SEEN) + 1


@pytest.mark.parametrize(("world", "inspections"), [(ERASED, 1), (MOVED, 4)])
def test_with_the_liar_in_the_answer_a_box_is_repaired(world, inspections):
    """Taken from a fusion without it, although there was no time to find out who it is."""
    decision, tested = world.play(1, GroupTesting(MODEL, GroupTestingSettings(inspections=inspections)), quiet=6)[0]
    assert LIAR in decision.accepted
    ((judged, row),) = there(decision, tested, decision.objects)
    assert judged.support.status is Standing.REPAIRED
    assert LIAR not in judged.subset
    np.testing.assert_array_equal(row, TRUE[world])


@pytest.mark.parametrize(("off_m", "status"), [(0.5, Standing.REPAIRED), (1.6, Standing.DISPUTED)])
def test_what_is_less_out_of_place_and_still_is_so_is_not_repaired(off_m, status):
    said = {EGO: YES, "car-2": YES, "car-3": YES, LIAR: NO}
    world = World(said, lambda subset: CAR + [3.3 if LIAR in subset else off_m, 0, 0, 0, 0, 0])
    decision, tested = world.play(1, GroupTesting(MODEL, GroupTestingSettings(inspections=4)), quiet=6)[0]
    assert LIAR in decision.accepted
    ((judged, row),) = there(decision, tested, decision.objects)
    np.testing.assert_array_equal(row, CAR[0] + [off_m, 0, 0, 0, 0, 0])
    assert (judged.support.status, LIAR in judged.subset) == (status, False)


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


@pytest.mark.parametrize(
    ("seen", "status", "against"),
    [
        ({"car-2": 0.0, "car-3": 0.0, "rsu": 1.2}, Standing.DISPUTED, {"rsu"}),
        ({"car-2": 0.0, "car-3": 0.0, "rsu": 0.7}, Standing.CONFIRMED, set()),  # it may err so much
        ({EGO: 1.2, "car-2": 0.0, "car-3": 0.0}, Standing.DISPUTED, {EGO}),
        ({EGO: 1.2, "rsu": 1.2, "car-2": 0.0, "car-3": 0.0}, Standing.DISPUTED, {EGO, "rsu"}),
        ({EGO: 0.0, "rsu": 1.2}, Standing.CONFIRMED, set()),  # the ego sees for itself
        ({EGO: 1.2, "rsu": 1.2, "car-2": 0.0, "car-3": 0.0, "car-4": 0.0}, Standing.CONFIRMED, set()),  # not three
        ({"rsu": 1.2}, Standing.SINGLE_WITNESS, set()),  # there is no second word
    ],
)
def test_a_box_whose_vehicle_a_witness_sees_elsewhere_is_disputed(seen, status, against):
    """By so many metres aside of the box; two that vouch for it may have moved it together."""
    speaking = {name: [(*PLACE, YES)] for name in seen}
    centres = {name: [PLACE + (0.0, aside)] for name, aside in seen.items()}
    testimony = saying({name: speaking.get(name, []) for name in (EGO, *TEAM)}, seen=centres)
    answer = Shown(tuple(TEAM), CAR, Hearing(testimony, ()))
    ((judged,), contradicted) = judge(answer, [answer])
    assert contradicted == ()
    assert judged.support.status is status
    assert set(judged.support.deniers) == against
    assert set(judged.support.witnesses) == set(seen) - against


def test_a_sure_box_that_nobody_speaks_of_is_left_out_and_accuses_nobody_yet():
    defense = GroupTesting(MODEL, GroupTestingSettings(inspections=0))
    decision, tested = World({LIAR: -0.5}, lambda _: SURE).play(1, defense)[0]
    ((judged, _),) = there(decision, tested, decision.contradicted)
    assert judged.support == Support(status=Standing.CONTRADICTED, witnesses=(), deniers=())
    assert there(decision, tested, decision.objects) == []
    assert decision.named == ()


@pytest.mark.parametrize("score", [0.12, 0.29, 0.31, 0.5])
def test_a_vehicle_that_is_repaired_is_there_once(score):
    """A faint box gives way to what is taken from a fusion of a part; one in its place needs none."""
    testimony = World({"car-2": YES, "car-3": YES, "rsu": YES}, nothing).testimony
    part = Shown(("car-2", "car-3", "rsu"), np.vstack([SEEN, NEAR]), Hearing(testimony, ()))
    own = NEAR + [0.2, 0, 0, 0, 0, score - NEAR[0, 5]]
    boxes = np.vstack([SEEN, own] if score < 0.3 else [SEEN, ASIDE, own])
    answer = Shown(("car-2", "car-3", LIAR, "rsu"), boxes, Hearing(testimony, ()))
    objects, contradicted = judge(answer, [answer, part])
    assert contradicted == ()
    assert len(objects) == len(SEEN) + 1
    (place,) = [judged for judged in objects if judged.index >= len(SEEN)]
    repaired = score < 0.3
    assert (place.subset, place.index) == ((part.teammates, 8) if repaired else (answer.teammates, 9))
    assert (place.support.status is Standing.REPAIRED) == repaired


@pytest.mark.parametrize(("off", "score"), [((3.3, 0.0), 0.85), ((3.3, 0.0), 0.35), ((0.0, 2.1), 0.85)])
@pytest.mark.parametrize("accomplices", [(), ("car-2",)])
def test_where_a_vehicle_is_taken_back_nothing_stays_of_what_it_was_moved_to(off, score, accomplices):
    there = PLACE + off
    words = {name: [(*place, YES) for place in SEEN[:, :2]] for name in (EGO, *TEAM)}
    for name in (EGO, "car-3", "rsu"):
        words[name] += [(*PLACE, YES), (*(PLACE + 1.4 * np.sign(off) + off), -1.0)]
    for name in (LIAR, *accomplices):
        words[name].append((*there, YES))
    hearing = Hearing(saying(words), ())
    moved = CAR + [*off, 0, 0, 0, score - CAR[0, 5]]
    answer = Shown(("car-2", "car-3", LIAR, "rsu"), np.vstack([SEEN, moved]), hearing)
    part = Shown(("car-2", "car-3", "rsu"), np.vstack([SEEN, CAR]), hearing)
    objects, contradicted = judge(answer, [answer, part])
    assert contradicted == ()
    assert {(judged.subset, judged.index) for judged in objects} == {
        *((answer.teammates, index) for index in range(len(SEEN))),
        (part.teammates, len(SEEN)),
    }


def test_two_boxes_out_of_place_that_stand_for_one_vehicle_are_repaired_as_one():
    testimony = World({"car-2": YES, "car-3": YES, "rsu": YES}, nothing).testimony
    part = Shown(("car-2", "car-3", "rsu"), np.vstack([SEEN, NEAR]), Hearing(testimony, ()))
    boxes = np.vstack([SEEN, ASIDE, CAR - [0, 1.6, 0, 0, 0, 0]])
    answer = Shown(("car-2", "car-3", LIAR, "rsu"), boxes, Hearing(testimony, ()))
    assert answer.displaced.sum() == 2
    objects, _ = judge(answer, [answer, part])
    assert [judged.subset for judged in objects if judged.index >= len(SEEN)] == [part.teammates]


@pytest.mark.parametrize(
    ("team", "said", "stands"),
    [
        ((LIAR,), {EGO: 6.5, LIAR: NO}, True),
        ((LIAR,), {EGO: 6.5}, True),
        ((LIAR,), {EGO: 2.0, LIAR: NO}, False),
        (("car-2", LIAR), {EGO: 6.5}, False),  # the fusion of either is asked
    ],
)
def test_what_the_ego_sees_alone_the_only_one_that_sends_does_not_take_away(team, said, stands):
    known = {name: [(*place, YES) for place in SEEN[:, :2]] + [(*PLACE, said.get(name, 0.0))] for name in (EGO, *team)}
    hearing = Hearing(saying(known), ())
    answer, of_ego = Shown(team, SEEN, hearing), Shown((), np.vstack([SEEN, CAR]), hearing)
    objects, contradicted = judge(answer, [answer], of_ego=of_ego)
    assert contradicted == ()
    taken = [box for box in objects if box.subset == ()]
    assert [(box.index, box.support.status) for box in taken] == [(len(SEEN), Standing.REPAIRED)] * stands


def test_a_session_answers_what_the_ego_sees_alone_too():
    world = World({EGO: 6.5, LIAR: NO}, nothing, team=(LIAR,))
    world.alone = np.vstack([SEEN, CAR])
    ((decision, _),) = world.play(1)
    assert decision.accepted == (LIAR,)
    (taken,) = [judged for judged in decision.objects if judged.subset == ()]
    assert (taken.index, taken.support.status) == (len(SEEN), Standing.REPAIRED)


@pytest.mark.parametrize("kept", [True, False])
def test_where_the_only_one_that_sends_shows_something_near_the_ego_alone_adds_nothing(kept):
    """Unless that is left out itself."""
    known = {name: [(*place, YES) for place in SEEN[:, :2]] + [(*PLACE, 6.5)] for name in (EGO, LIAR)}
    hearing = Hearing(saying(known), ())
    faint = ASIDE + [0, 0, 0, 0, 0, 0.4 - ASIDE[0, 5]]
    answer, of_ego = (Shown(team, np.vstack([SEEN, car]), hearing) for team, car in (((LIAR,), faint), ((), CAR)))
    stays = np.array([True] * len(SEEN) + [kept])
    assert _holes(answer, stays, of_ego) == [len(SEEN)] * (not kept)


def test_where_only_the_ego_is_heard_its_word_is_enough():
    testimony = World({EGO: YES, "car-2": NO}, lambda _: CAR).testimony
    shown = Shown(("car-2",), np.vstack([SEEN, CAR]), Hearing(testimony, TEAM))
    objects, contradicted = judge(shown, [shown])
    assert {box.support.status for box in objects} == {Standing.CONFIRMED}
    assert contradicted == ()


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


def test_by_the_word_of_one_against_one_nobody_is_suspected_and_the_vehicle_is_shown_as_disputed():
    """An eraser takes away what one honest teammate alone sees. Or an attacker lets its ghost show only without the
    honest one that denies it. Nobody can tell which.
    """
    world = World({"car-2": YES, LIAR: NO}, lambda subset: CAR[:0] if LIAR in subset else seen_by("car-2")(subset))
    met = world.play(70)  # whoever is not cleared meanwhile is left out after some fifty frames
    for decision, tested in met[1:]:
        assert set(decision.accepted) == set(TEAM)
        ((judged, _),) = there(decision, tested, decision.objects)
        assert judged.support == Support(status=Standing.DISPUTED, witnesses=("car-2",), deniers=(LIAR,))
    assert max(met[-1][0].suspicion.values()) < 0.05


@pytest.mark.parametrize(("rsu", "repaired"), [(YES, True), (0.0, False)])
def test_whoever_takes_a_vehicle_away_has_no_say_in_its_repair(rsu, repaired):
    """By the word of two others; one of them alone who sees it does not outweigh a third who denies it."""
    said = {"car-2": YES, "rsu": rsu, LIAR: NO, **({} if repaired else {"car-3": NO})}
    hearing = Hearing(World(said, nothing).testimony, ())
    part = Shown(("car-2", "car-3", "rsu"), np.vstack([SEEN, CAR]), hearing)
    answer = Shown(("car-2", "car-3", LIAR, "rsu"), SEEN, hearing)
    objects, _ = judge(answer, [answer, part])
    assert [judged.subset for judged in objects[len(SEEN) :]] == [part.teammates] * repaired
