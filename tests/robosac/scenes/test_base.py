from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from robosac.detectors import DetectorError, Message, TensorSpec
from robosac.scenes import IntersectionScene, SceneError, View, one_scene, whose_turn
from robosac.scenes.base import encoded


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


class Odd:
    """A detector that encodes what it was given instead of a scan."""

    def __init__(self, made):
        layout = {"map": TensorSpec("float32", (2, 2))}
        self.info = SimpleNamespace(name="odd", tensors={"ego": layout, "teammate": layout})
        self.made = made

    def encode(self, points, pose):
        return self.made


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (None, "a Message, got a NoneType"),
        (Message(np.eye(4), {}), r"a message with map of float32 \[2, 2\], got none"),
        (Message(np.eye(4), {"map": np.zeros((2, 2))}), r"map of float32 \[2, 2\], got map of float64 \[2, 2\]"),
        (Message(np.eye(4), {"mop": np.zeros((2, 2), np.float32)}), r", got mop of float32 \[2, 2\]"),
        (Message(np.eye(4), {"map": torch.zeros(2, 2)}), "numpy arrays; map is a Tensor"),
        (Message(np.eye(4), {"map": np.full((2, 2), np.nan, np.float32)}), "finite numbers; map holds others"),
    ],
)
def test_what_a_detector_encodes_has_to_be_what_it_declares(made, words):
    with pytest.raises(DetectorError, match=f"^odd: encode must return .*{words}$"):
        encoded(View(np.eye(4), np.zeros((1, 3))), Odd(made))


def test_a_message_as_declared_is_taken_as_it_is():
    made = Message(np.eye(4), {"map": np.zeros((2, 2), np.float32)})
    assert encoded(View(np.eye(4), np.zeros((1, 3))), Odd(made)) is made
