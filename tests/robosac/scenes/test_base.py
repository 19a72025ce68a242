from dataclasses import dataclass

import pytest

from robosac.scenes import IntersectionScene, SceneError, one_scene, whose_turn


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


class Few:
    name = "few"

    def scenes(self, split):
        return [IntersectionScene(4), Brief(5)]


class Brief(IntersectionScene):
    @property
    def length(self):
        return 3


def test_a_scene_is_had_by_its_place_whatever_the_others_are_like():
    assert one_scene(Few(), "test", 0, frames=9, team=5).number == 4
    assert one_scene(Few(), "test", 1, frames=3).number == 5
    for place, frames, team, why in (
        (2, 1, 1, "few has 2 test scenes; that number 2, from 0 on, is wanted"),
        (1, 4, 1, "few, scene 5 has 3 frames; 4 are wanted"),
        (0, 1, 6, "few, scene 4 has 5 teammates; 6 are wanted"),
    ):
        with pytest.raises(SceneError, match=why):
            one_scene(Few(), "test", place, frames, team)
