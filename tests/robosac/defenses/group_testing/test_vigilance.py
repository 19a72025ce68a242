"""Everybody is looked at again once the boxes of the answers stand farther from where witnesses see the vehicles."""

import json
from dataclasses import replace

import pytest

from robosac.defenses import EGO
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.objects import Shown
from robosac.defenses.group_testing.vigilance import LEARNING, USUAL_FRAMES, Vigilance
from tests.robosac.defenses.group_testing.conversing import TEAM
from tests.robosac.defenses.group_testing.one_place import LIAR, SEEN, YES, World, nothing
from tests.robosac.testifying import saying

QUIET = 20
"""Frames after which nobody is left out any more where nobody lies."""


def shown(by, speaking=(EGO, *TEAM), boxes=SEEN):
    """A fusion in which all boxes are so far aside of where those who speak see the vehicles."""
    said = saying({name: [(x, y, YES) for x, y in SEEN[:, :2]] if name in speaking else [] for name in (EGO, *TEAM)})
    return Shown(TEAM, boxes + [0, by, 0, 0, 0, 0], Hearing(said, ()))


def alarms(vigilance, *offs):
    return [vigilance.learn(shown(by)) for by in offs]


def test_what_is_always_off_is_usual_and_a_rise_is_not():
    vigilance = Vigilance()
    assert not any(alarms(vigilance, *[0.2] * 40))
    assert vigilance.level == 0.0
    assert True in alarms(vigilance, *[0.4] * 4)


def test_a_rise_as_small_as_honest_frames_show_never_adds_up():
    assert not any(alarms(Vigilance(), *[0.0] * USUAL_FRAMES, *[0.06] * 40))


def test_after_an_alarm_all_is_learned_anew():
    vigilance = Vigilance()
    told = alarms(vigilance, *[0.0] * 10, *[0.4] * 30)
    assert sum(told) == 1
    assert vigilance.frames == min(29 - told[10:].index(True), USUAL_FRAMES)


def test_boxes_that_come_nearer_are_no_reason():
    vigilance = Vigilance()
    assert not any(alarms(vigilance, *[0.4] * 10, *[0.0] * 10))


def test_one_frame_alone_does_not_tell_nor_do_the_first_ones():
    assert not any(alarms(Vigilance(), *[0.0] * 10, 1.4, 0.0))
    assert alarms(Vigilance(), *[0.0] * 10, 1.4, 1.4) == [False] * 11 + [True]
    assert not any(alarms(Vigilance(), *[0.0] * (LEARNING - 2), 1.0, 1.0))


@pytest.mark.parametrize(("speaking", "boxes"), [((EGO,), SEEN), ((EGO, *TEAM), SEEN[:0]), ((), SEEN)])
def test_nothing_is_learned_where_fewer_than_two_see_the_vehicles(speaking, boxes):
    vigilance = Vigilance(0.1, 10, 0.5)
    assert not vigilance.learn(shown(1.0, speaking, boxes))
    assert vigilance == Vigilance(0.1, 10, 0.5)


def test_it_is_remembered():
    memory = Memory(vigilance=Vigilance(0.25, 7, 1.5))
    state = json.loads(json.dumps(memory.to_state()))
    assert Memory.from_state(state).vigilance == memory.vigilance
    older = {key: value for key, value in state.items() if key != "vigilance"}
    assert Memory.from_state(older).vigilance == Vigilance()


class Shifting(World):
    """Whoever fuses the liar has all vehicles aside, by less than testimony tells of one."""

    def judge(self, subset, *rest):
        outcome = super().judge(subset, *rest)
        return replace(outcome, boxes=outcome.boxes + [0, 0.2 * (LIAR in subset), 0, 0, 0, 0])


@pytest.mark.parametrize("watching", [True, False])
def test_who_begins_once_it_has_proved_harmless_is_found(watching, monkeypatch):
    if not watching:
        monkeypatch.setattr(Vigilance, "learn", lambda *_: False)
    met = Shifting({}, nothing).play(12, quiet=QUIET)
    asked = [sum(len(subset) == len(TEAM) - 1 for subset in tested) for _, tested in met]
    accepted = [LIAR in decision.accepted for decision, _ in met]
    assert accepted[0]
    assert any(asked) == watching
    assert any(accepted[6:]) != watching
    assert all(set(decision.accepted) >= set(TEAM) - {LIAR} for decision, _ in met)
    assert not any(decision.named for decision, _ in met)


def test_where_nothing_changes_nobody_is_looked_at_again():
    met = World({}, nothing).play(30, quiet=QUIET)
    assert not any(len(subset) == len(TEAM) - 1 for _, tested in met[:15] for subset in tested)
    assert met[-1][0].state["memory"]["vigilance"] == [pytest.approx(0.0, abs=0.01), USUAL_FRAMES, 0.0]
