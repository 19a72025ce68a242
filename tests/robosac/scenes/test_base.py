from dataclasses import dataclass

import pytest

from robosac.scenes import SceneError, whose_turn


@dataclass
class Frame:
    views: dict
    index: int = 5


class Scene:
    number, egos = 3, ("a", "b", "c")


def frame(names):
    return Frame(dict.fromkeys(names))


def test_vehicles_take_turns():
    everybody = frame("abcr")
    assert [whose_turn(Scene(), turn, everybody, everybody) for turn in range(5)] == ["a", "b", "c", "a", "b"]


def test_who_is_absent_from_one_of_the_frames_is_passed_over():
    assert [whose_turn(Scene(), turn, frame("abcr"), frame("acr")) for turn in range(3)] == ["a", "c", "a"]


def test_nobody_may_be_there():
    with pytest.raises(SceneError, match="scene 3, frame 5: nobody is there who may be the ego"):
        whose_turn(Scene(), 0, frame("ab"), frame("cr"))
