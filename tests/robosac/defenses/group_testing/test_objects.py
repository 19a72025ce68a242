"""What a fusion does to single objects, and on whom it is blamed."""

from dataclasses import replace

import numpy as np
import pytest

from robosac.defenses.group_testing.differences import carried, effects, gone, misplaced
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.objects import SLACK_ACROSS_M, Shown
from tests.robosac.testifying import SPREAD_M, saying

PLACE = np.array([10.4, 4.3])
ELSEWHERE = np.array([-12.4, -7.3])
YES, NO = 5.5, -7.0
TEAM = ("a", "b", "c", "d")


def car(place=PLACE, score=0.85, off=(0.0, 0.0), yaw=0.0):
    """A box whose centre is off its place along and across itself, metres."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = place + [off[0] * cos - off[1] * sin, off[0] * sin + off[1] * cos]
    return np.array([[x, y, 4.5, 1.9, yaw, score]])


REST = car(ELSEWHERE)
NOTHING = np.zeros((0, 6))


def hearing(unheard=(), place=PLACE, **said):
    """What the ego and teammates say of a place; somewhere else the ego and "a" see a car."""
    words = {"": said.pop("ego", 0.0), **{name: said.get(name, 0.0) for name in TEAM}}
    known = {name: [(*place, value)] for name, value in words.items()}
    for name in ("", "a"):
        known[name].append((*ELSEWHERE, YES))
    return Hearing(saying(known), unheard)


def found(heard, joined, without, suspect="d"):
    """What is blamed on a suspect for a box joined with it, and one without it."""
    others = tuple(name for name in TEAM if name != suspect)
    lies = effects(
        Shown(TEAM, np.vstack([REST, joined]), heard), Shown(others, np.vstack([REST, without]), heard), [suspect]
    )
    assert all(np.hypot(*(lie.place - PLACE)) < 2.5 for lie in lies)
    return [lie.kind for lie in lies]


DENIED = {"ego": -2.0, "b": NO, "c": NO, "d": YES}
SEEN = {"b": YES, "c": YES}


def test_a_ghost_is_blamed_on_whoever_brings_it():
    heard = hearing(**DENIED)
    assert found(heard, car(), NOTHING) == ["ghost"]
    assert found(heard, car(), car(score=0.2)) == ["ghost"]
    assert found(heard, car(), car(), suspect="a") == []  # it is there without "a"
    assert found(heard, car(score=0.5), car(score=0.35)) == []  # hardly changed
    assert found(heard, car(score=0.25), NOTHING) == []  # hardly shown
    assert found(heard, NOTHING, car()) == []  # made up by somebody else


@pytest.mark.parametrize(
    ("said", "kinds"),
    [
        ({}, []),
        ({"b": NO}, []),
        ({"b": NO, "d": NO}, []),  # its own word is not against it
        ({"ego": -5.0}, []),  # one word against another
        ({"ego": NO}, ["ghost"]),
        ({"ego": NO, "b": -3.0}, ["ghost"]),
        ({"ego": YES, "b": NO, "c": NO}, []),
    ],
)
def test_a_box_that_nobody_can_deny_is_blamed_on_nobody(said, kinds):
    assert found(hearing(**said), car(), NOTHING) == kinds


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


def test_a_vehicle_gone_is_blamed_on_whoever_takes_it_away():
    heard = hearing(**SEEN, d=NO)
    assert found(heard, NOTHING, car()) == ["gone"]
    assert found(heard, car(off=(5.0, 0.0)), car()) == ["gone"]  # moved out of its place
    assert found(heard, car(off=(3.3, 0.0)), car()) == ["gone"]  # by less than its length
    assert found(heard, car(score=0.2), car()) == ["gone"]  # as good as none
    assert found(heard, car(score=0.35), car()) == []
    assert found(heard, NOTHING, car(score=0.45)) == []  # never crisp
    assert found(heard, NOTHING, NOTHING) == []  # gone without it too
    assert found(heard, NOTHING, NOTHING, suspect="a") == []


@pytest.mark.parametrize(
    ("said", "kinds"),
    [({}, []), ({"b": 3.5}, []), ({"d": YES}, []), ({"b": YES, "c": YES, "a": NO}, []), (SEEN, ["gone"])],
)
def test_a_vehicle_that_two_others_see_is_missed(said, kinds):
    assert found(hearing(**said), NOTHING, car()) == kinds


@pytest.mark.parametrize(
    ("said", "off", "off_without", "some"),
    [
        (SEEN, (0.0, 3.8), (0.0, 0.1), True),
        ({"ego": YES, "b": 1.0}, (-3.9, 0.0), (0.0, 0.0), True),
        (SEEN, (0.0, 0.9), (0.0, 0.0), False),
        (SEEN, (4.1, 0.0), (0.0, 0.0), False),
        (SEEN, (0.0, 0.0), (0.0, 2.1), False),  # put right
        ({"b": 7.5}, (0.0, 3.8), (0.0, 0.0), False),  # one alone, however sure
        ({"b": YES, "d": YES}, (0.0, 3.8), (0.0, 0.0), False),  # its own word
        ({"b": 3.2, "c": 3.2, "a": -1.0}, (0.0, 3.8), (0.0, 0.0), False),
    ],
)
def test_a_vehicle_is_carried_off_from_where_others_see_it(said, off, off_without, some):
    heard = hearing(**said)
    joined = Shown(TEAM, np.vstack([REST, car(off=off)]), heard)
    without = Shown(("a", "b", "c"), np.vstack([car(off=off_without), REST]), heard)
    assert carried(joined, without, ["d"]).tolist() == ([[1], [0]] if some else [[], []])
    both = Shown(TEAM, np.vstack([REST, car(off=off), car(off=off_without)]), heard)
    assert carried(both, without, ["d"]).size == 0  # it is where it was, and what is beside it is another one
    beside = np.vstack([without.boxes, car(off=(off[0] * 1.4, off[1] * 1.4))])
    assert carried(joined, Shown(("a", "b", "c"), beside, heard), ["d"]).size == 0  # another one is nearer
    for empty in (Shown(TEAM, NOTHING, heard), Shown(TEAM, car(score=0.3), heard)):
        assert carried(empty, without, ["d"]).size == carried(joined, empty, ["d"]).size == 0


def test_a_vehicle_is_carried_off_by_the_word_of_those_who_see_it_elsewhere():
    """So near that the place is not empty, and out of place by nobody's word: none of them supports the box."""
    words = {name: [(*PLACE, YES), (*(PLACE + [0.0, 3.5]), -1.0)] for name in ("", "b", "c")} | {"a": [], "d": []}
    heard = Hearing(saying(words), ())
    joined, without = Shown(TEAM, car(off=(0.0, 2.1)), heard), Shown(("a", "b", "c"), car(), heard)
    assert joined.away(["d"]).tolist() == [0.0]
    assert gone(joined, without, ["d"]).size == 0
    (lie,) = effects(joined, without, ["d"])
    assert (lie.kind, lie.counts_as, set(lie.by)) == ("moved", "moved", {"", "b", "c"})


@pytest.mark.parametrize(
    ("said", "without", "missed"),
    [
        ({}, car(), 1),
        ({"d": NO}, car(), 1),
        ({"d": YES}, car(), 1),
        ({"c": NO}, car(), 0),  # one more who says that it is none
        ({}, car(score=0.45), 0),
    ],
)
def test_a_vehicle_that_one_other_is_certain_of_is_missed_by_one_word_against_one(said, without, missed):
    heard = hearing(b=YES, **said)
    lies = effects(Shown(TEAM, REST, heard), Shown(("a", "b", "c"), np.vstack([REST, without]), heard), ["d"])
    assert [lie.counts_as for lie in lies] == ["alone"] * missed
    assert effects(Shown(("b", "d"), REST, heard), Shown(("b",), np.vstack([REST, without]), heard), ["d"]) == []


@pytest.mark.parametrize(("said", "some"), [(SEEN, True), ({"b": YES}, False), ({"b": YES, "d": YES}, False)])
def test_boxes_that_are_moved_a_little_are_misplaced_by_the_word_of_two_others(said, some):
    heard = hearing(**said)
    near = Shown(("a", "b", "c"), np.vstack([car(off=(0.0, 0.1)), REST]), heard)
    aside = Shown(TEAM, np.vstack([car(off=(0.0, 0.5)), REST]), heard)
    grown = 0.4 / (0.2 + SLACK_ACROSS_M) / np.sqrt(2) if some else 0.0
    assert misplaced(aside, near, ["d"]) == pytest.approx(grown, abs=0.1)
    assert misplaced(near, aside, ["d"]) == pytest.approx(-grown, abs=0.1)
    far = Shown(TEAM, np.vstack([car(off=(0.0, 1.4)), REST]), heard)
    assert misplaced(far, near, ["d"]) == pytest.approx(
        2.0 / np.sqrt(2) if some else 0.0
    )  # a single box counts no more
    assert misplaced(Shown(TEAM, NOTHING, heard), near, ["d"]) == 0.0


@pytest.mark.parametrize("off", [(0.0, 1.5), (0.0, -1.5), (1.8, 0.0)])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_vehicle_moved_is_blamed_on_whoever_moves_it(off, yaw):
    heard, moved, near = hearing(**SEEN, a=YES), car(off=off, yaw=yaw), car(off=(0.1, 0.1), yaw=yaw)
    assert found(heard, moved, near) == ["moved"]
    assert found(heard, moved, moved) == []
    assert found(heard, near, moved) == []
    assert found(hearing(**{"b": YES}), moved, near) == []  # one witness may be wrong itself
    assert found(hearing(**{"b": YES, "d": YES}), moved, near) == []  # as may the suspect


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


def test_what_a_fusion_has_lost_is_found_by_its_part():
    heard = hearing(**SEEN)
    part = Shown(("b", "c"), np.vstack([car(), REST]), heard)
    assert gone(Shown(TEAM, REST, heard), part).tolist() == [0]
    assert gone(Shown(TEAM, np.vstack([REST, car()]), heard), part).tolist() == []
    assert gone(Shown(TEAM, REST, hearing()), Shown(("b", "c"), np.vstack([car(), REST]), hearing())).size == 0


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
