"""What it takes to be named: to be more unsteady than the ego itself, by nothing but one's own fusions."""

import json

import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.defenses import Outcome
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import make_model

MODEL = make_model()
STEADY = {"boxes": 20, "jumping": 0}
"""A fusion of 20 boxes, none of which jumps aside from one frame to the next."""


def boxes(number, jumping, frame):
    found = np.array([[10.0 * i, 0.0, 4.0, 2.0, 0.0, 0.9] for i in range(number)]).reshape(-1, 6)
    found[:jumping, 1] += 3.0 * (frame % 2)
    return found


def play(frames, *, team, ego=STEADY, memory=None, compare_frames=True):
    """Memory after frames in which each of a team has its fusion decoded: what it shows, by name."""
    memory = memory or Memory()
    for number in frames:
        known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, sorted(team)), memory)
        evidence = Evidence(known, compare_frames=compare_frames)
        alone = boxes(ego["boxes"], ego["jumping"], number)
        for name, shown in team.items():
            fused = boxes(shown["boxes"], shown["jumping"], number)
            evidence.learn(Outcome((name,), 0.9, Verdict.CONSENSUS, fused, alone, np.eye(4), number, alone=alone))
        evidence.compare_singles()
        memory.shown, memory.shown_in = evidence.shown, number
        memory.frame += 1
        memory = Memory.from_state(json.loads(json.dumps(memory.to_state())))
    return memory


def level(shown, frames=2, **options):
    return play(range(frames), team={"a": shown}, **options).steadiness.levels.get("a", 0.0)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        ({"boxes": 20, "jumping": 6}, 12 * np.log(2.5) - 0.15 * 20),  # each comes and goes
        ({"boxes": 5, "jumping": 3}, 6 * np.log(2.5) - 0.15 * 12),  # as if there were 12
        ({"boxes": 30, "jumping": 30}, 15.0),  # no frame counts for more
        (STEADY, 0.0),
        ({"boxes": 20, "jumping": 1}, 0.0),
    ],
)
def test_a_frame_adds_the_logarithm_of_the_ratio_of_two_rates(shown, expected):
    assert level(shown) == pytest.approx(expected, abs=1e-3)


def test_frames_add_up_and_steady_ones_take_off():
    wild, calm = {"boxes": 20, "jumping": 6}, {"boxes": 20, "jumping": 0}
    step = 12 * np.log(2.5) - 3.0
    assert level(wild, 4) == pytest.approx(3 * step, abs=1e-2)
    memory = play(range(3), team={"a": wild})
    assert memory.steadiness.names("a")
    later = play(range(4, 8), team={"a": calm}, memory=memory)  # frame 3 is missing: 4 has nothing before it
    assert later.steadiness.levels["a"] == pytest.approx(2 * step - 3 * 3.0, abs=1e-2)
    assert not later.steadiness.names("a")
    assert "a" not in play(range(8, 20), team={"a": calm}, memory=later).steadiness.levels


def test_an_ego_that_jumps_lets_others_jump():
    wild = {"boxes": 20, "jumping": 6}
    assert level(wild, ego={"boxes": 20, "jumping": 6}) < 1.0
    assert level(wild, ego={"boxes": 20, "jumping": 1}) > 0.5 * level(wild) > 0.0


def test_an_ego_that_was_unsteady_before_is_remembered():
    before = play(range(12), team={"a": STEADY}, ego={"boxes": 20, "jumping": 6})
    wild = {"boxes": 20, "jumping": 6}
    calm_now = play(range(12, 14), team={"a": wild}, memory=before).steadiness.levels.get("a", 0.0)
    assert calm_now < 0.5 * level(wild)


def test_no_third_party_enters():
    wild, jumpy = {"boxes": 20, "jumping": 6}, {"boxes": 30, "jumping": 25}
    alone = level(wild, 3)
    for others in ({"b": jumpy, "c": jumpy}, {"b": STEADY}):
        beside = play(range(3), team={"a": wild, **others}).steadiness
        assert beside.levels["a"] == alone
    framed = play(range(3), team={"a": STEADY, "b": jumpy, "c": jumpy}).steadiness
    assert "a" not in framed.levels
    assert {name for name in "abc" if framed.names(name)} == {"b", "c"}


def test_frames_that_cannot_be_compared_say_nothing():
    wild = {"boxes": 20, "jumping": 6}
    assert level(wild, 1) == 0.0
    assert level(wild, 6, compare_frames=False) == 0.0
    assert play([0, 3, 6, 9], team={"a": wild}).steadiness.levels == {}
    blind = play(range(4), team={"a": wild}, ego={"boxes": 0, "jumping": 0})
    assert blind.steadiness.levels.get("a", 0.0) > 0.0  # nothing seen is nothing that flickers


def test_who_leaves_is_forgotten():
    memory = play(range(4), team={"a": {"boxes": 20, "jumping": 6}})
    memory.leave("a", 0.9, named=False)
    assert memory.steadiness.levels == {}
