import numpy as np
import pytest

from robosac.scenes import IntersectionScene, encoded
from robosac.scenes.disturbances import _LATE, Biased, Covered, Dropped, JumpingEgo, Late, NarrowEgo, NoisyScanner, Rain
from robosac.scenes.recorded import Recording
from tests.recorded import write

SCENE = IntersectionScene(4)
TEAM = SCENE.agents[1:]
EVERYTHING = (Covered, Rain, NoisyScanner, Late, Dropped, Biased, JumpingEgo, NarrowEgo)


def changed(scene, index, what):
    """Agents whose view is not that of the plain scene."""
    plain, other = SCENE.frame(index).views, scene.frame(index).views
    return [name for name in SCENE.agents if not np.array_equal(getattr(plain[name], what), getattr(other[name], what))]


def offsets(scene, index):
    plain, other = SCENE.frame(index).views, scene.frame(index).views
    return {name: (other[name].pose - plain[name].pose)[:2, 3] for name in SCENE.agents}


@pytest.mark.parametrize("disturbed", EVERYTHING)
def test_a_disturbed_scene_is_still_that_scene(disturbed):
    scene = disturbed(SCENE)
    assert (scene.number, scene.length, scene.frame_period_s) == (4, None, 0.2)
    assert (scene.agents, scene.egos) == (SCENE.agents, SCENE.egos)
    frame = scene.frame(6)
    assert frame.index == 6
    for name in ("car-1", "car-3"):
        np.testing.assert_array_equal(frame.truth(name), SCENE.frame(6).truth(name))
    again = disturbed(SCENE).frame(6)
    assert list(frame.views) == list(again.views)
    for name, view in frame.views.items():
        np.testing.assert_array_equal(view.points, again.views[name].points)
        np.testing.assert_array_equal(view.pose, again.views[name].pose)


def test_rain_takes_more_returns_from_afar():
    scene, plain = Rain(SCENE), SCENE.frame(0).views
    assert changed(scene, 0, "points") == list(SCENE.agents)
    assert changed(scene, 0, "pose") == []
    for name, view in scene.frame(0).views.items():
        before, after = (np.linalg.norm(v.points, axis=1) for v in (plain[name], view))
        near, far = (
            ((after >= a) & (after < b)).sum() / ((before >= a) & (before < b)).sum() for a, b in ((0, 5), (25, 35))
        )
        assert near == pytest.approx(0.7 * np.exp(-4 / 60), abs=0.05)
        assert far == pytest.approx(0.7 * np.exp(-30 / 60), abs=0.05)
    first, second = (Rain(SCENE, missing=0.5, reach_m=np.inf).frame(i).views["rsu"].points for i in (0, 1))
    assert len(first) != len(second)
    assert len(first) == pytest.approx(0.5 * len(plain["rsu"].points), rel=0.05)


def test_one_teammates_scanner_is_noisy_along_the_ray():
    scene = NoisyScanner(SCENE, noise_m=0.4)
    (name,) = changed(scene, 0, "points")
    assert name in TEAM
    assert changed(scene, 3, "points") == [name]
    before, after = SCENE.frame(0).views[name].points, scene.frame(0).views[name].points
    longer = np.linalg.norm(after, axis=1) - np.linalg.norm(before, axis=1)
    assert longer.std() == pytest.approx(0.4, rel=0.05)
    assert abs(longer.mean()) < 0.02
    np.testing.assert_allclose(np.cross(before, after), 0.0, atol=1e-3)
    assert {NoisyScanner(IntersectionScene(n)).one_of_them(7) for n in range(20)} == {(name,) for name in TEAM}


@pytest.mark.parametrize("fresh", [True, False])
def test_a_late_teammate_sends_the_frame_before(fresh):
    scene = Late(SCENE, fresh_pose=fresh)
    assert changed(scene, 0, "points") == []  # it has nothing older
    (name,) = changed(scene, 1, "points")
    assert name in TEAM
    assert changed(scene, 9, "points") == [name]
    old, now, sent = SCENE.frame(8).views[name], SCENE.frame(9).views[name], scene.frame(9).views[name]
    np.testing.assert_array_equal(sent.points, old.points)
    np.testing.assert_array_equal(sent.pose, now.pose if fresh else old.pose)


def test_all_teammates_may_be_late_by_several_frames():
    scene = Late(SCENE, everybody=True, fresh_pose=False, frames=3)
    assert changed(scene, 2, "points") == []
    for index in (5, 3, 4, 7):
        assert changed(scene, index, "points") == list(TEAM)
        for name in TEAM:
            old, sent = SCENE.frame(index - 3).views[name], scene.frame(index).views[name]
            np.testing.assert_array_equal(sent.points, old.points)
            np.testing.assert_array_equal(sent.pose, old.pose)


@pytest.mark.parametrize(
    ("how", "sensed"),
    [
        ({"frames": 0, "every": 3}, [0, 0, 0, 3, 3, 3, 6, 6]),
        ({"frames": 0, "slower_every": 2}, [0, 1, 1, 2, 2, 3, 3, 4]),
        ({"frames": 1, "every": 2}, [0, 1, 1, 1, 3, 3, 5, 5]),
    ],
    ids=["again", "slower", "both"],
)
def test_a_teammate_may_send_the_same_again_or_be_later_and_later(how, sensed):
    scene = Late(SCENE, fresh_pose=False, **how)
    (late,) = scene.one_of_them(_LATE)
    for order in (range(8), reversed(range(8))):
        for index in order:
            view = scene.frame(index).views[late]
            expected = SCENE.frame(sensed[index]).views[late]
            assert np.array_equal(view.points, expected.points)
            assert np.array_equal(view.pose, expected.pose)


def test_a_covered_scanner_sees_its_cover_alone():
    scene = Covered(SCENE, first=2, frames=3)
    for index in range(7):
        off = {name: np.linalg.norm(view.points, axis=1) for name, view in scene.frame(index).views.items()}
        covered = [name for name, far in off.items() if far.max() < 1.3]
        assert len(covered) == (2 <= index < 5)
        assert all(np.std(off[name]) == pytest.approx(0.03, rel=0.2) for name in covered)


def test_frames_that_are_late_are_not_made_twice():
    asked = []

    class Counting:
        def __getattr__(self, name):
            return getattr(SCENE, name)

        def frame(self, index):
            asked.append(index)
            return SCENE.frame(index)

    scene = Late(Counting())
    for index in range(4):
        scene.frame(index)
    assert asked == [0, 1, 2, 3]


def test_a_tenth_of_the_messages_is_dropped_and_never_the_egos():
    scene = Dropped(SCENE)

    class Present:
        index = 0
        views = dict.fromkeys(SCENE.agents)

    lost = dict.fromkeys(SCENE.agents, 0)
    for Present.index in range(2000):
        for name in set(SCENE.agents) - set(scene.views(Present)):
            lost[name] += 1
    assert lost.pop("car-1") == 0
    for times in lost.values():
        assert times / 2000 == pytest.approx(0.1, abs=0.03)


def test_each_teammate_has_its_own_bias_and_keeps_it():
    first, later = (offsets(Biased(SCENE, bias_m=0.2), index) for index in (0, 9))
    np.testing.assert_array_equal(first.pop("car-1"), 0.0)
    for name, offset in first.items():
        np.testing.assert_allclose(np.abs(offset), 0.2, atol=1e-12)
        np.testing.assert_allclose(later[name], offset, atol=1e-12)
    assert len({tuple(np.sign(offset)) for offset in first.values()}) > 1
    assert changed(Biased(SCENE), 0, "points") == []


def test_only_the_ego_jumps_and_anew_in_each_frame():
    scene = JumpingEgo(SCENE, error_m=0.1, error_deg=0.2)
    assert changed(scene, 0, "pose") == ["car-1"]
    jumps, turns = [], []
    plain = SCENE.frame(0)
    for index in range(400):
        object.__setattr__(plain, "index", index)
        pose, before = scene.views(plain)["car-1"].pose, plain.views["car-1"].pose
        jumps.append((pose - before)[:2, 3])
        turned = pose[:3, :3] @ before[:3, :3].T
        turns.append(np.rad2deg(np.arctan2(turned[1, 0], turned[0, 0])))
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.std(jumps, axis=0), 0.1, rtol=0.15)
    assert np.std(turns) == pytest.approx(0.2, rel=0.15)


def test_a_narrow_ego_sees_only_what_is_ahead():
    scene = NarrowEgo(SCENE, view_deg=90.0)
    assert changed(scene, 0, "points") == ["car-1"]
    assert not changed(scene, 0, "pose")
    plain, seen = (each.frame(0).views["car-1"].points for each in (SCENE, scene))
    ahead = np.abs(plain[:, 1]) <= plain[:, 0]
    np.testing.assert_array_equal(seen, plain[ahead])
    assert 0 < len(seen) < len(plain)


def test_disturbances_go_around_each_other():
    scene = Dropped(Late(Rain(SCENE), everybody=True), share=0.5)
    frame, rain = scene.frame(3), Rain(SCENE)
    assert 1 < len(frame.views) < 6
    for name in set(frame.views) - {"car-1"}:
        np.testing.assert_array_equal(frame.views[name].points, rain.frame(2).views[name].points)
    np.testing.assert_array_equal(frame.views["car-1"].points, rain.frame(3).views["car-1"].points)


def test_who_is_absent_from_the_scene_stays_absent():
    absent = Dropped(SCENE, share=0.9)
    for disturbed in EVERYTHING:
        assert set(disturbed(absent).frame(2).views) <= set(absent.frame(2).views)


def test_a_scene_without_teammates_can_be_disturbed():
    class Alone:
        number, agents, egos, length, frame_period_s = 0, ("car-1",), ("car-1",), None, 0.2

        def frame(self, index):
            frame = SCENE.frame(index)
            return type(frame)(index, frame.vehicles, {"car-1": frame.views["car-1"]}, frame.carriers)

    for disturbed in EVERYTHING:
        assert list(disturbed(Alone()).frame(1).views) == ["car-1"]


@pytest.fixture(scope="module")
def recorded(detector, recorded_moments, tmp_path_factory):
    (scene,) = Recording(write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, recorded_moments)).scenes(
        "test"
    )
    return scene


@pytest.mark.parametrize("disturbed", EVERYTHING)
def test_recorded_messages_stay_what_was_sent(disturbed, recorded, detector):
    scene = disturbed(recorded)
    frame, now, before = scene.frame(3), recorded.frame(3).views, recorded.frame(2).views
    late = scene.one_of_them(_LATE) if disturbed is Late else ()
    for name, view in frame.views.items():
        sent = (before if name in late else now)[name]
        np.testing.assert_array_equal(
            encoded(view, detector).tensors["features"], encoded(sent, detector).tensors["features"]
        )
    assert set(frame.views) == set(now) or disturbed is Dropped
    assert frame.attackers == ("car-2",)


@pytest.mark.parametrize("fresh", [True, False])
def test_a_late_message_of_a_recording_has_the_pose_that_it_should(fresh, recorded, detector):
    now, before, sent = recorded.frame(3), recorded.frame(2), Late(recorded, everybody=True, fresh_pose=fresh).frame(3)
    for name in recorded.agents[1:]:
        message = encoded(sent.views[name], detector)
        np.testing.assert_array_equal(message.pose, (now if fresh else before).views[name].pose)
        np.testing.assert_array_equal(message.tensors["features"], before.views[name].message.tensors["features"])
