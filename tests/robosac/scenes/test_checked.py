import pickle
from dataclasses import dataclass, field, replace
from functools import partial, partialmethod
from types import SimpleNamespace

import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.detectors import Message
from robosac.scenes import SceneError, View, load_source
from robosac.scenes.checked import CheckedScene, CheckedSource
from robosac.scenes.intersection import Synthetic

POINTS = np.arange(12.0).reshape(4, 3)
BOX = np.array([[1.0, 2.0, 4.0, 2.0, 0.1]])
SOUND = View(pose_matrix(1.0, 2.0, 1.9, 0.3), POINTS)


@dataclass(frozen=True)
class Frame:
    index: int = 0
    views: dict = field(default_factory=lambda: {"van-0": SOUND})
    boxes: object = field(default_factory=lambda: BOX)
    attackers: tuple = ("van-0",)

    def truth(self, ego):
        if isinstance(self.boxes, Exception):
            raise self.boxes
        return self.boxes


@dataclass(frozen=True)
class Late(Frame):
    """A frame that is the next one."""

    def __post_init__(self):
        object.__setattr__(self, "index", self.index + 1)


@dataclass(frozen=True)
class Scene:
    shown: object = field(default_factory=Frame)
    number = 7
    length = 50
    frame_period_s = 0.2
    agents = egos = ("van-0",)

    def frame(self, index):
        if isinstance(self.shown, Exception):
            raise self.shown
        return replace(self.shown, index=index)


class Source:
    name = "t7"

    def __init__(self, shown=None):
        self.shown = Frame() if shown is None else shown

    def scenes(self, split):
        return [Scene(self.shown)]


def frame(shown, index=3):
    (scene,) = CheckedSource(Source(shown)).scenes("test")
    return scene.frame(index)


def seen(pose=SOUND.pose, points=POINTS, **more):
    return Frame(views={"van-0": View(pose, points, **more)})


def holed(rows):
    points = POINTS.copy()
    points[rows] = np.nan
    return points


def test_what_is_sound_stays_as_it_is():
    found = frame(Frame())
    assert (found.index, found.attackers) == (3, ("van-0",))
    assert found.views["van-0"] is SOUND
    assert found.truth("van-0") is BOX
    assert not hasattr(found, "nearby")
    for empty in (np.empty((0, 5)), np.array([])):
        assert frame(Frame(boxes=empty)).truth("van-0").shape == (0, 5)
    for points in (POINTS[:0], np.hstack([POINTS, POINTS]), holed([0, 2]), POINTS.astype(int)):
        assert frame(seen(points=points)).views["van-0"].points is points
    message = Message(SOUND.pose, {})
    assert frame(seen(points=None, message=message)).views["van-0"].message is message


def test_a_period_is_a_plain_number_as_json_has_it():
    scene = CheckedScene(type("Odd", (Scene,), {"frame_period_s": np.float32(0.5)})(), "t7")
    assert type(scene.frame_period_s) is float


def test_a_scene_is_what_it_was():
    (scene,) = CheckedSource(Source()).scenes("test")
    assert (scene.number, scene.length, scene.frame_period_s) == (7, 50, 0.2)
    assert scene.agents == scene.egos == ("van-0",)
    assert pickle.loads(pickle.dumps(scene.frame(4))).attackers == ("van-0",)


TILTED = pose_matrix(0.0, 0.0, 0.0, 0.0)[:, [2, 1, 0, 3]] * [-1, 1, 1, 1]


@pytest.mark.parametrize(
    ("shown", "why"),
    [
        (Frame(views={"van-0": None}), "van-0: must be a View, got a NoneType"),
        (Frame(views={"van-0": (SOUND.pose, POINTS)}), "van-0: must be a View, got a tuple"),
        (seen(pose=np.eye(3)), "van-0: pose must be 4 x 4 finite numbers, got (3, 3)"),
        (seen(pose=[1, 2, 3]), "van-0: pose must be 4 x 4 finite numbers, got a list"),
        (seen(pose=SOUND.pose * np.nan), "van-0: pose must be 4 x 4 finite numbers, got some that are not"),
        (seen(pose=SOUND.pose.T), "van-0: pose must be a rigid transform: a rotation, a translation, last row 0 0 0 1"),
        (seen(pose=np.zeros((4, 4))), "van-0: pose must be a rigid transform"),
        (seen(pose=TILTED), "van-0: pose must be upright"),
        (seen(points=POINTS.T[:2]), ""),
        (seen(points=POINTS[:, :2]), "van-0: points must be (P, 3), got (4, 2)"),
        (seen(points=POINTS[0]), "van-0: points must be (P, 3), got (3,)"),
        (seen(points=POINTS.tolist()), "van-0: points must be (P, 3), got a list"),
        (seen(points=holed([0, 1, 2, 3])), "van-0: points must be finite numbers, and none is"),
        (FileNotFoundError(2, "No such file", "3.npz"), "FileNotFoundError: [Errno 2] No such file: '3.npz'"),
        (np.linalg.LinAlgError("Singular\n matrix"), "LinAlgError: Singular matrix"),
        (SceneError("there is no more"), "there is no more"),
    ],
)
def test_views_of_a_wrong_form_are_refused(shown, why):
    if not why:
        frame(shown)
        return
    with pytest.raises(SceneError) as refused:
        frame(shown)
    assert str(refused.value).startswith(f"t7, scene 7, frame 3: {why}")


@pytest.mark.parametrize(
    ("shown", "why"),
    [
        (Frame(views={"van-0": SOUND, "van-1": SOUND}), "'van-1' has a view, and is no agent of the scene"),
        (Frame(attackers="van-0"), "attackers must be some of the agents, got 'van-0'"),
        (Frame(attackers=("van-1",)), r"attackers must be some of the agents, got \('van-1',\)"),
        (Late(), "index must be the one that is asked for, got 4"),
    ],
)
def test_frames_that_do_not_belong_to_the_scene_are_refused(shown, why):
    with pytest.raises(SceneError, match=f"^t7, scene 7, frame 3: {why}$"):
        frame(shown)


@pytest.mark.parametrize(
    ("boxes", "why"),
    [
        (np.zeros((6, 7)), " must be (G, 5), got (6, 7)"),
        (np.zeros(5), " must be (G, 5), got (5,)"),
        (BOX.tolist(), " must be (G, 5), got a list"),
        (BOX * np.nan, " must be finite numbers"),
        (BOX.astype(object), " must be finite numbers"),
        (BOX * [1, 1, -1, 1, 1], " must have positive lengths and widths, got -4"),
        (BOX + [0, 0, 0, 0, -90], " must have yaws in radians, got -89.9: is it in degrees?"),
        (KeyError("van-0"), ": KeyError: 'van-0'"),
    ],
)
def test_boxes_of_a_wrong_form_are_refused(boxes, why):
    with pytest.raises(SceneError) as refused:
        frame(Frame(boxes=boxes), 0).truth("van-0")
    assert str(refused.value) == f"t7, scene 7, frame 0: truth('van-0'){why}"


def test_a_text_names_no_attackers_though_its_letters_are_agents():
    scene = CheckedScene(type("Short", (Scene,), {"agents": ("a", "b")})(Frame(views={}, attackers="ab")), "t7")
    with pytest.raises(SceneError, match="attackers must be some of the agents, got 'ab'"):
        scene.frame(0)


@pytest.mark.parametrize("name", [7, ""])
def test_a_source_has_a_text_for_a_name(name):
    source = Source()
    source.name = name
    with pytest.raises(SceneError, match=f"^the name of a scene source must be a text, got {name!r}$"):
        CheckedSource(source).scenes("test")


class Kept(Source):
    def training_scenes(self):
        return [Scene(FileNotFoundError("gone"))]


class Broken(Source):
    def scenes(self, split):
        raise OSError("no such disk")


def test_scenes_for_training_are_checked_where_there_are_some():
    assert not hasattr(CheckedSource(Source()), "training_scenes")
    (scene,) = CheckedSource(Kept()).training_scenes()
    with pytest.raises(SceneError, match="t7, scene 7, frame 0: FileNotFoundError: gone"):
        scene.frame(0)
    with pytest.raises(SceneError, match="t7: OSError: no such disk"):
        CheckedSource(Broken()).scenes("test")


def test_what_ships_is_not_checked_and_what_does_not_is(tmp_path, monkeypatch):
    assert type(load_source("synthetic")) is Synthetic
    (tmp_path / "own_source.py").write_text("from tests.robosac.scenes.test_checked import Kept as Made\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    made = load_source("own_source:Made")
    assert isinstance(made, CheckedSource)
    for copy in (made, pickle.loads(pickle.dumps(made))):
        assert isinstance(copy.scenes("test")[0], CheckedScene)
        assert isinstance(copy.training_scenes()[0], CheckedScene)


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("agents", (), r"agents must be a sequence of one or more ids, got \(\)"),
        ("agents", "van-0", "agents must be a sequence of one or more ids, got 'van-0'"),
        ("agents", (0, 1), r"agents must be a sequence of one or more ids, got \(0, 1\)"),
        ("egos", (), r"egos must be a sequence of one or more ids, got \(\)"),
        ("agents", {"van-0"}, "agents must be a sequence of one or more ids, got {'van-0'}"),
        ("agents", ("van-0", "van-0"), r"agents must be distinct, got \('van-0', 'van-0'\)"),
        ("length", True, "length must be a number of frames or None, got True"),
        ("egos", ("van-9",), r"egos must be some of the agents, got \('van-9',\)"),
        ("length", "50", "length must be a number of frames or None, got '50'"),
        ("length", -1, "length must be a number of frames or None, got -1"),
        ("frame_period_s", 0, "frame_period_s must be a positive number of seconds, got 0"),
        ("frame_period_s", None, "frame_period_s must be a positive number of seconds, got None"),
        ("frame_period_s", np.nan, "frame_period_s must be a positive number of seconds, got nan"),
    ],
)
def test_what_a_scene_says_of_itself_is_checked(part, value, words):
    scene = CheckedScene(type("Odd", (Scene,), {part: value})(), "t7")
    with pytest.raises(SceneError, match=f"^t7, scene 7: {words}$"):
        getattr(scene, part)


def test_a_scene_may_have_no_end():
    assert CheckedScene(type("Endless", (Scene,), {"length": None})(), "t7").length is None


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ([1, 2, 1], "two scenes have the number 1"),
        ([-1], "a scene's number must be an integer, not negative, got -1"),
        (["2021_08_18"], "a scene's number must be an integer, not negative, got '2021_08_18'"),
    ],
)
def test_scenes_have_numbers_of_their_own(numbers, why):
    class Numbered(Source):
        def scenes(self, split):
            return [SimpleNamespace(number=number) for number in numbers]

        training_scenes = partialmethod(scenes, "training")

    source = CheckedSource(Numbered())
    for asked in (partial(source.scenes, "test"), source.training_scenes):
        with pytest.raises(SceneError) as refused:
            asked()
        assert str(refused.value) == f"t7: {why}"
