"""One car is shown turned or stretched: nobody says so, but each of the others shows it as it is."""

import numpy as np
import pytest

from robosac.answers import Standing
from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.objects import Shown
from robosac.defenses.group_testing.posterior import Posterior
from robosac.defenses.group_testing.shapes import agreeing, reshaped, to_ask
from tests.robosac.defenses.group_testing.one_place import CAR, LIAR, MODEL, PLACE, SEEN, YES, World, there, with_liar
from tests.robosac.testifying import saying

TURNED = CAR + [0.1, 0, 0, 0, np.pi / 4, 0]
STRETCHED = CAR * [1, 1, 1.7, 1.7, 1, 1]
SHRUNK = CAR * [1, 1, 0.6, 0.6, 1, 1]
SEE_IT = {"car-2": YES, "car-3": YES, "rsu": YES, LIAR: YES}
OTHERS = ("car-2", "car-3", "rsu")
TEAM = ("car-2", "car-3", LIAR, "rsu")


def shown(team, *boxes, said=SEE_IT):
    """What a fusion shows."""
    words = {name: [(*PLACE, said.get(name, 0.0))] for name in (EGO, *TEAM)}
    return Shown(team, np.vstack([SEEN, *boxes]), Hearing(saying(words), ()))


@pytest.mark.parametrize("lie", [TURNED, STRETCHED, SHRUNK])
def test_it_is_answered_as_the_others_show_it_and_nobody_named(lie):
    """Once everybody was left out; a detector that is unsure of a shape shows one so, too, though all are honest."""
    played = World(SEE_IT, with_liar(lie, CAR)).play(10)
    for decision, tested in played[4:]:
        assert LIAR in decision.accepted
        ((judged, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, CAR[0])
        assert judged.support.status is Standing.REPAIRED
    state = decision.state
    assert decision.named == ()
    assert state["suspicion"][LIAR] < 0.1
    assert state["memory"]["lies"]["levels"][LIAR] == {"reshaped": [3.0, 3.0]}


def test_whoever_is_to_blame_is_noted_with_the_place():
    decision, _ = World(SEE_IT, with_liar(TURNED, CAR)).play(6)[-1]
    (noted,) = [each for each in decision.differences if each.test == "objects"]
    assert set(noted.teammates) - set(noted.beside) == {LIAR}
    np.testing.assert_array_equal(noted.places()["reshaped"], TURNED[:, :2])


def test_an_honest_teammate_that_puts_a_shape_right_is_not_blamed():
    """An attacker shows the car turned wherever a certain other one is not fused, too."""
    world = World(SEE_IT, lambda subset: TURNED if LIAR in subset and "rsu" not in subset else CAR)
    for decision, tested in world.play(10):
        ((_, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, CAR[0])
        assert "rsu" not in decision.state["memory"]["lies"]["levels"]
    assert len(decision.state["memory"]["lies"]["audited"]) == len(TEAM) + 1


@pytest.mark.parametrize(("ego", "by"), [(CAR, (EGO,)), (TURNED, ()), (CAR[:0], ())])
def test_the_ego_is_believed_without_asking_anybody(ego, by):
    world = World({**SEE_IT, EGO: YES}, with_liar(TURNED, CAR))
    world.alone = np.vstack([SEEN, ego])
    known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), Memory())
    found = Findings(known, Lies(), TEAM, ())
    for team in (TEAM, OTHERS):
        found.learn(world.judge(team, None, 0))
    assert [words for *_, words in found.reshaped(TEAM, OTHERS, (LIAR,))] == ([by] if by else [])
    assert found.effects(TEAM, OTHERS, (LIAR,)) == []  # one alone blames nobody


def test_where_nobody_else_is_asked_the_shape_stays_as_it_is_fused():
    settings = GroupTestingSettings(inspections=0, budget=1)
    for decision, tested in World(SEE_IT, with_liar(TURNED, CAR)).play(3, GroupTesting(MODEL, settings), quiet=6):
        ((judged, row),) = there(decision, tested, decision.objects)
        np.testing.assert_array_equal(row, TURNED[0])
        assert judged.support.status is Standing.CONFIRMED


@pytest.mark.parametrize(
    ("box", "differs"),
    [
        (TURNED, True),
        (STRETCHED, True),
        (SHRUNK, True),
        (CAR + [0, 0, 0, 0, np.pi, 0], False),
        (CAR + [0, 0, 0, 0, np.pi / 2, 0], True),
        (CAR * [1, 1, 1.1, 1.1, 1, 1], False),
        (TURNED + [0.6, 0, 0, 0, 0, 0], False),
        (TURNED - [0, 0, 0, 0, 0, 0.3], False),
        (CAR * [1, 1, 0, 0, 1, 1], True),
    ],
)
def test_boxes_in_one_place_differ_by_their_overlap(box, differs):
    found = reshaped(shown(TEAM, box), shown(OTHERS, CAR), (LIAR,))
    assert found.T.tolist() == ([[len(SEEN), len(SEEN)]] if differs else [])


@pytest.mark.parametrize(
    ("seeing", "known"), [((), False), (("rsu",), False), (("rsu", "car-2"), True), ((EGO,), True)]
)
def test_two_others_or_the_ego_have_to_see_the_vehicle(seeing, known):
    said = {LIAR: YES, **dict.fromkeys(seeing, YES)}
    found = reshaped(shown(TEAM, TURNED, said=said), shown(OTHERS, CAR, said=said), (LIAR,))
    assert bool(found.size) == known


def test_nothing_differs_where_nothing_is():
    assert reshaped(shown(TEAM), shown(OTHERS), (LIAR,)).shape == (2, 0)


def test_those_are_asked_who_support_it_most():
    said = {"car-2": 4.0, "car-3": 2.0, "rsu": 6.0, LIAR: 7.0, EGO: 7.0}
    assert to_ask(shown(OTHERS, CAR, said=said), len(SEEN)) == ("rsu", "car-2")


@pytest.mark.parametrize(
    ("alone", "by"),
    [
        ({}, ()),
        ({"a": CAR}, ()),
        ({EGO: CAR}, (EGO,)),
        ({"a": CAR, "b": CAR}, ("a", "b")),
        ({"a": CAR, "b": CAR, "c": TURNED}, ("a", "b")),
        ({EGO: CAR, "c": TURNED}, ()),
        ({"a": CAR, "b": CAR, "c": TURNED, "d": TURNED}, ()),
        ({"a": CAR, "b": CAR - [0, 0, 0, 0, 0, 0.5]}, ()),
        ({"a": CAR, "b": CAR + [2, 0, 0, 0, 0, 0]}, ()),
        ({"a": CAR, "b": CAR[:0]}, ()),
        ({"a": CAR, "b": CAR + [0, 0, 0, 0, np.pi / 8, 0]}, ()),
        ({"a": CAR, "b": CAR - [0, 0, 0, 0, np.pi / 8, 0]}, ()),
    ],
)
def test_the_word_of_the_ego_or_of_two_counts_and_of_more_than_say_the_contrary(alone, by):
    assert agreeing(TURNED[0], CAR[0], alone) == by
