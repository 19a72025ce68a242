"""Lies that show only beside an honest teammate, which is to be blamed for them."""

import pytest

from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.lies import SPARED_FRAMES, Lies
from tests.robosac.defenses.group_testing.one_place import (
    ASIDE,
    CAR,
    DRIVING_MOVED,
    DRIVING_VEILED,
    LIAR,
    MODEL,
    NEAR,
    NO,
    YES,
    World,
    with_liar,
)

FRAMED, UNSURE = "rsu", -0.5
DRIVING_MUTE = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(CAR[:0], CAR), speed=4.0)
OTHERS = ("car-2", "car-3", "car-5")
DENIED, SUPPORTED = dict.fromkeys((EGO, *OTHERS), NO), {EGO: UNSURE, **dict.fromkeys(OTHERS, YES)}


def beside(shown, otherwise, *liars):
    """What fusions of the framed and any of the liars show, and all others."""
    return lambda subset: shown if FRAMED in subset and set(liars) & set(subset) else otherwise


def and_faintly_alone(shows, score):
    """The framed alone shows something there, too."""
    faint = CAR * [1, 1, 1, 1, 1, 0] + [0, 0, 0, 0, 0, score]
    return lambda subset: faint if subset == (FRAMED,) else shows(subset)


MOVED_A_LITTLE = World(
    {**SUPPORTED, LIAR: -2.0, FRAMED: UNSURE}, beside(CAR + [0, 1.3, 0, 0, 0, 0], NEAR, LIAR), speed=4.0
)
WORLDS = {
    "ghost near a faint box": World(
        {**DENIED, LIAR: NO, FRAMED: UNSURE}, and_faintly_alone(beside(CAR, CAR[:0], LIAR), 0.3), speed=1.0
    ),
    "ghost": World({**DENIED, LIAR: NO, FRAMED: UNSURE}, beside(CAR, CAR[:0], LIAR), speed=1.0),
    "ghost of either of two": World({**DENIED, LIAR: NO, FRAMED: UNSURE}, beside(CAR, CAR[:0], LIAR, "car-5"), 1.0),
    "gone": World({**SUPPORTED, LIAR: YES, FRAMED: UNSURE}, beside(CAR[:0], CAR, LIAR), speed=4.0),
    "moved": World({**SUPPORTED, LIAR: UNSURE, FRAMED: UNSURE}, beside(ASIDE, NEAR, LIAR), speed=4.0),
}


@pytest.mark.parametrize("quiet", [0, 10])
@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
def test_who_is_needed_for_anothers_lie_is_not_named_for_it(world, quiet):
    met = world.play(25, quiet=quiet)
    assert not any(FRAMED in decision.named for decision, _ in met)
    assert max(decision.suspicion[FRAMED] for decision, _ in met) < 0.7  # as either of the two may be behind it
    assert quiet == 0 or FRAMED in met[-1][0].accepted


@pytest.mark.parametrize("quiet", [0, 10])
@pytest.mark.parametrize(
    ("said", "shown", "otherwise", "mistaken"),
    [
        ({**DENIED, LIAR: NO}, CAR, CAR[:0], YES),
        ({**DENIED, LIAR: UNSURE}, CAR, CAR[:0], YES),
        ({**SUPPORTED, LIAR: YES}, CAR[:0], CAR, NO),
        ({**SUPPORTED, LIAR: UNSURE}, CAR[:0], CAR, NO),
    ],
    ids=["ghost denied", "ghost", "gone denied", "gone"],
)
def test_nor_is_whose_own_message_goes_with_it_by_mistake(said, shown, otherwise, mistaken, quiet):
    world = World({**said, FRAMED: mistaken}, beside(shown, otherwise, LIAR), speed=4.0)
    assert not any(FRAMED in decision.named for decision, _ in world.play(12, quiet=quiet))


@pytest.mark.parametrize("quiet", [0, 10])
def test_a_box_that_is_hardly_moved_does_not_seem_so_without_each_other(quiet):
    assert not any(FRAMED in decision.named for decision, _ in MOVED_A_LITTLE.play(25, quiet=quiet))


def test_who_shows_a_ghost_alone_is_named_for_it_though_its_own_message_denies_it():
    met = DRIVING_VEILED.play(12, quiet=10)
    assert met[-1][0].named == (LIAR,)
    assert any((LIAR,) in tested for _, tested in met)


@pytest.mark.parametrize("inspections", [2, 3, 4])
@pytest.mark.parametrize("world", [DRIVING_MOVED, DRIVING_MUTE], ids=["moved", "gone"])
def test_who_says_nothing_of_its_lie_is_named_for_it_however_little_can_be_asked(world, inspections):
    defense = GroupTesting(MODEL, GroupTestingSettings(inspections=inspections))
    met = world.play(16, defense, quiet=8)
    assert met[-1][0].named == (LIAR,)


def test_without_whom_a_lie_was_there_is_known_for_some_frames():
    lies = Lies()
    assert lies.not_spared(LIAR, "gone", OTHERS, 3) == set(OTHERS)
    lies.spare(LIAR, "gone", ["car-2"], 3)
    lies.spare(LIAR, "gone", ["car-5"], 5)
    lies = Lies.from_state(lies.to_state())
    assert lies.not_spared(LIAR, "gone", OTHERS, 3 + SPARED_FRAMES - 1) == {"car-3"}
    assert lies.not_spared(LIAR, "gone", OTHERS, 3 + SPARED_FRAMES) == {"car-2", "car-3"}
    assert lies.not_spared(FRAMED, "gone", OTHERS, 5) == lies.not_spared(LIAR, "moved", OTHERS, 5) == set(OTHERS)
    lies.forget("car-5")
    assert lies.not_spared(LIAR, "gone", OTHERS, 6) == {"car-3", "car-5"}
    lies.forget(LIAR)
    assert lies.to_state()["spared"] == {}
