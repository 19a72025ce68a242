"""What somebody's joining does to single objects, and on whom it is blamed."""

import numpy as np
import pytest

from robosac.defenses.group_testing.differences import carried, effects, gone, misplaced, persists
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.objects import SLACK_ACROSS_M, Lie, Shown
from tests.robosac.defenses.group_testing.fusions import (
    DENIED,
    NO,
    NOTHING,
    PLACE,
    REST,
    SEEN,
    TEAM,
    YES,
    car,
    hearing,
)
from tests.robosac.testifying import saying


def found(heard, joined, without, suspect="d"):
    """What is blamed on a suspect for a box joined with it, and one without it."""
    others = tuple(name for name in TEAM if name != suspect)
    lies = effects(
        Shown(TEAM, np.vstack([REST, joined]), heard), Shown(others, np.vstack([REST, without]), heard), [suspect]
    )
    assert all(np.hypot(*(lie.place - PLACE)) < 2.5 for lie in lies)
    return [lie.kind for lie in lies]


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


@pytest.mark.parametrize(("far", "lost"), [(2.9, 0), (3.1, 1)])
def test_nobody_takes_away_the_ego_itself(far, lost):
    """Others see it, and where their messages are late, beside where it is."""
    place = np.array([far, 0.0])
    heard = hearing(place=place, b=YES, c=YES)
    joined, without = Shown(TEAM, NOTHING, heard), Shown(("a", "b", "c"), car(place), heard)
    assert len(gone(joined, without)) == lost
    assert len(effects(joined, without, ["d"])) == lost


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


def test_what_a_fusion_has_lost_is_found_by_its_part():
    heard = hearing(**SEEN)
    part = Shown(("b", "c"), np.vstack([car(), REST]), heard)
    assert gone(Shown(TEAM, REST, heard), part).tolist() == [0]
    assert gone(Shown(TEAM, np.vstack([REST, car()]), heard), part).tolist() == []
    assert gone(Shown(TEAM, REST, hearing()), Shown(("b", "c"), np.vstack([car(), REST]), hearing())).size == 0


@pytest.mark.parametrize(
    ("kind", "part", "without", "there"),
    [
        ("ghost", car(), NOTHING, True),
        ("ghost", car(score=0.55), NOTHING, True),
        ("ghost", car(score=0.45), NOTHING, False),  # as a detector makes many of them up by itself
        ("ghost", car(score=0.6), car(score=0.45), False),
        ("gone", NOTHING, car(), True),
        ("gone", car(), car(), False),
        ("moved", car(off=(0.0, 0.1)), car(off=(0.0, 1.3)), True),
        ("moved", car(off=(0.0, 0.5)), car(off=(0.0, 1.3)), True),
        ("moved", car(off=(0.0, 1.2)), car(off=(0.0, 1.3)), False),  # put right but for some centimetres
        ("moved", NOTHING, car(off=(0.0, 1.3)), False),
    ],
)
def test_a_lie_is_there_in_a_part_of_a_fusion_too(kind, part, without, there):
    heard = hearing()
    shown, other = (Shown(("a", "d"), np.vstack([REST, boxes]), heard) for boxes in (part, without))
    assert persists(Lie(kind, PLACE), shown, other) == there
