"""How a fusion is checked by what the messages say."""

from dataclasses import replace

import numpy as np
import pytest

from robosac.defenses.group_testing.differences import effects
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.objects import Shown
from tests.robosac.defenses.group_testing.fusions import (
    DENIED,
    ELSEWHERE,
    NO,
    PLACE,
    REST,
    SEEN,
    TEAM,
    YES,
    car,
    hearing,
)
from tests.robosac.testifying import SPREAD_M, saying


@pytest.mark.parametrize(
    ("said", "score", "nobodys"),
    [
        ({}, 0.95, True),
        ({"ego": 1.0, "a": 2.8, "b": NO}, 0.95, True),
        ({"d": NO}, 0.95, True),  # whoever brings it lets its own message deny it
        ({}, 0.85, False),
        ({"c": 3.5}, 0.95, False),
        ({"d": 3.5}, 0.95, False),
        ({"ego": 3.5}, 0.95, False),
    ],
)
def test_a_sure_box_is_on_somebodys_word_or_contradicted(said, score, nobodys):
    for unheard in ((), ("c", "d")):  # who is not heard has seen something, too
        heard = hearing(unheard, **said)
        shown = Shown(TEAM, np.vstack([REST, car(score=score)]), heard)
        assert shown.contradicted.tolist() == [False, nobodys]
        lies = effects(shown, Shown(("a", "b", "c"), REST, heard), ["d"])
        assert [lie.counts_as for lie in lies] == ["veiled"] * nobodys


def test_while_some_messages_are_unread_no_box_is_on_nobodys_word():
    testimony = hearing().everybody
    for unread, nobodys in (((), True), (("b",), False)):
        shown = Shown(TEAM, car(score=0.95), Hearing(replace(testimony, unread=unread), ()))
        assert shown.contradicted.tolist() == [nobodys]


def test_a_hole_is_where_vehicles_stand_and_nothing_is_shown():
    heard = hearing(**SEEN)
    (hole,) = Shown(TEAM, REST, heard).lies
    assert hole.kind == "gone"
    assert hole.place == pytest.approx(PLACE, abs=0.1)  # where they see it, not the middle of a place
    assert Shown(TEAM, np.vstack([REST, car()]), heard).lies == []
    assert Shown(TEAM, np.vstack([REST, car(score=0.3, off=(1.0, 0.5))]), heard).lies == []
    assert len(Shown(TEAM, np.vstack([REST, car(score=0.29, off=(1.0, 0.5))]), heard).holes) == 1
    assert [lie.kind for lie in Shown(TEAM, car(), heard).lies] == ["gone"]  # the other one


def test_a_box_beside_a_vehicle_covers_it_if_others_support_the_box():
    for said, holes in (([], 1), ([(*(PLACE + [3.4, 0.0]), YES)], 0)):
        known = {name: [(*PLACE, YES), (*ELSEWHERE, YES), *said] for name in ("b", "c")}
        heard = Hearing(saying({"": [], "a": [], **known, "d": [(*(PLACE + [3.4, 0.0]), YES)]}), ())
        assert len(Shown(TEAM, np.vstack([REST, car(off=(3.4, 0.0))]), heard).holes) == holes


@pytest.mark.parametrize(
    ("said", "holes"),
    [
        ({"b": YES}, 0),
        ({"ego": YES, "b": YES}, 1),
        ({"b": YES, "c": YES, "d": NO}, 1),  # who denies it most does not count
        ({"b": YES, "c": YES, "d": NO, "a": NO}, 0),
        ({"b": 3.5, "c": YES}, 0),
    ],
)
def test_a_vehicle_stands_where_the_ego_or_two_know_it(said, holes):
    assert len(Shown(TEAM, REST, hearing(**said)).holes) == holes


@pytest.mark.parametrize(
    ("place", "missing"), [(PLACE, 1), ((0.4, -0.3), 0), ((3.4, -0.3), 1), ((31.4, 4.3), 0), ((4.3, -31.4), 0)]
)
def test_what_no_fusion_shows_is_not_missing(place, missing):
    """The ego itself, which others see, and what is at the edge of its map."""
    seen = dict.fromkeys("abcd", YES)
    assert [lie.kind for lie in Shown(TEAM, REST, hearing(place=np.array(place), **seen)).lies] == missing * ["gone"]


def test_all_that_may_be_wrong_is_told_of_a_fusion():
    ghost = Shown(TEAM, np.vstack([REST, car()]), hearing(**DENIED)).lies
    assert [(lie.kind, lie.place.tolist()) for lie in ghost] == [("ghost", PLACE.tolist())]
    moved = Shown(TEAM, np.vstack([REST, car(off=(0, 1.5))]), hearing(**SEEN)).lies
    assert [lie.kind for lie in moved] == ["moved"]


def test_the_word_of_those_unheard_counts_for_nothing():
    assert len(Shown(TEAM, REST, hearing(["c"], **SEEN)).lies) == 0
    assert len(Shown(TEAM, np.vstack([REST, car()]), hearing(["c"], **DENIED)).lies) == 0
    assert len(hearing(["c"], **SEEN).everybody.agents) == 5


def test_boxes_are_vouched_for_by_others_than_those_who_join():
    shown = Shown(TEAM, np.vstack([REST, car()]), hearing(c=YES, d=YES))
    assert shown.vouched(("d",)).tolist() == [True, True]
    assert shown.vouched(("c", "d")).tolist() == [True, True]  # not both have made it up
    alone = Shown(TEAM, np.vstack([REST, car()]), hearing(d=YES))
    assert alone.vouched(("c", "d")).tolist() == [True, False]


def test_boxes_are_in_place_by_the_word_of_others_than_those_who_join():
    heard = hearing(c=YES, d=YES)
    assert Shown(TEAM, car(off=(0.3, 0.1)), heard).in_place(("d",)).tolist() == [True]
    assert Shown(TEAM, car(off=(0.0, 1.0)), heard).in_place(("d",)).tolist() == [False]
    assert Shown(TEAM, car(), heard).in_place(("c", "d")).tolist() == [False]  # nobody else sees it


def test_odds_are_those_of_the_best_box_at_a_place():
    shown = Shown(TEAM, np.vstack([car(score=0.8), car(score=0.5, off=(1.0, 0)), REST]), hearing())
    odds = shown.odds_at(np.array([PLACE, PLACE + [3.0, 0], PLACE + [0, 9.0]]))
    assert odds == pytest.approx([np.log(4), 0.0, np.log(0.05 / 0.95)])


def test_a_vehicle_beside_one_that_is_shown_is_missed_too():
    """The words about neighbours run into each other."""
    beside = PLACE + [0.0, 3.4]
    known = {name: [(*PLACE, YES)] for name in ("", *TEAM)}
    for name in ("b", "c"):
        known[name].append((*beside, YES))
    ((x, y),) = Shown(TEAM, car(), Hearing(saying(known), ())).holes
    assert np.hypot(x - beside[0], y - beside[1]) < 1.0


@pytest.mark.parametrize(("score", "vouched"), [(0.9, False), (0.2, True)])
def test_who_sees_a_vehicle_beside_a_box_does_not_speak_for_that_box(score, vouched):
    """Unless nothing else is shown there: faint boxes are as good as none."""
    boxes = np.array([[10.0, 0.0, 4.5, 1.9, 0.0, 0.9], [10.0, 3.0, 4.5, 1.9, 0.0, score]])
    heard = saying({"": [], "a": [(10.0, SPREAD_M + 0.3, 6.0)]})
    assert Shown(("a",), boxes, Hearing(heard, ())).claims.supporting[1, 0] == vouched


def test_two_fusions_are_compared_once_in_each_way():
    heard, calls = hearing(**SEEN), []
    joined, without = Shown(TEAM, np.vstack([REST, car()]), heard), Shown(("a", "b", "c"), REST, heard)

    def compare(one, other):
        calls.append((one, other))
        return len(calls)

    assert [joined.beside(without, compare) for _ in range(2)] == [1, 1]
    assert without.beside(joined, compare) == 2
    assert calls == [(joined, without), (without, joined)]
    assert joined.overlap(without).tolist() == [[1.0], [0.0]]
