"""Attacks that remember, over recorded and live sequences."""

import numpy as np
import pytest

from clients.simulation import Fleet
from robosac.attacks import load_campaign
from robosac.calibration.verdicts import Trial, validation_stretches
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.frames import another_scene, foreign_views
from robosac.evaluation.recordings import Recordings, load, save
from robosac.scenes import IntersectionScene
from robosac.scenes.intersection import Synthetic
from tests.robosac.evaluation.test_recordings import same

SCENE = IntersectionScene(4)
FEW = IntersectionScene(4, car_agents=3)
"""With three teammates, since all subsets of them are recorded."""


def told(frame):
    return [(lie.kind, lie.number, lie.box.round(6).tolist()) for lie in frame.lies]


def features(frame, name):
    return frame.teammates[name].tensors["features"]


def test_a_frame_does_not_depend_on_which_others_are_recorded(detector, tmp_path):
    whole = Recordings(detector, FEW).sequence(3, "ghost", ["car-3"])
    assert all(frame.lies for frame in whole)
    Recordings(detector, FEW, folder=tmp_path).sequence(2, "ghost", ["car-3"])
    extended = Recordings(detector, FEW, folder=tmp_path).sequence(3, "ghost", ["car-3"])
    for one, other in zip(whole, extended, strict=True):
        assert same(one, other)
        assert told(one) == told(other)


def test_a_schedule_chooses_among_the_frames_of_the_whole_course(detector):
    recordings = Recordings(detector, FEW)
    awake = recordings.sequence(12, "frozen", ["car-3"])
    asleep = recordings.sequence(12, "frozen@asleep", ["car-3"])
    assert [frame.attackers for frame in asleep] == [frozenset()] * 10 + [{"car-3"}] * 2
    assert asleep[11] is awake[11]
    first = Recordings(detector, FEW).sequence(12, "frozen@asleep", ["car-3"])
    assert all(map(same, first, asleep))


def test_lies_survive_a_file(detector, tmp_path):
    frames = Recordings(detector, FEW).sequence(1, "displace", ["car-3"])
    save(tmp_path / "x.npz", {0: frames[0]}, whole=True)
    (again,) = load(tmp_path / "x.npz", detector, lambda _: []).values()
    (lie,), (before,) = again.lies, frames[0].lies
    assert (lie.kind, lie.number) == ("moved", 0)
    np.testing.assert_array_equal(lie.box, before.box)
    np.testing.assert_array_equal(lie.truth, before.truth)


def test_a_frozen_map_is_the_first_one_under_fresh_poses(detector):
    mover = next(n for n in SCENE.egos[1:] if not np.allclose(*(SCENE.frame(i).views[n].pose for i in (0, 3))))
    frames = Encounters(detector, SCENE).sequence(4, "frozen", [mover])
    assert [frame.attackers for frame in frames] == [frozenset()] + [{mover}] * 3
    for frame in frames[1:]:
        np.testing.assert_array_equal(features(frame, mover), features(frames[0], mover))
        np.testing.assert_array_equal(frame.teammates[mover].pose, frame.benign[mover].pose)
    assert not np.array_equal(frames[3].teammates[mover].pose, frames[0].teammates[mover].pose)


def test_a_stale_map_is_one_second_old(detector):
    frames = Encounters(detector, SCENE).sequence(8, "stale", ["car-3"])
    honest = [frame.benign["car-3"].tensors["features"] for frame in frames]
    assert [frame.attackers for frame in frames[:2]] == [frozenset(), {"car-3"}]
    for index, since in ((1, 0), (4, 0), (5, 0), (6, 1), (7, 2)):
        np.testing.assert_array_equal(features(frames[index], "car-3"), honest[since])


def test_a_copy_is_another_ones_map(detector):
    (frame,) = Encounters(detector, SCENE).sequence(1, "copy", ["car-3", "rsu"])
    np.testing.assert_array_equal(features(frame, "car-3"), frame.benign["car-4"].tensors["features"])
    np.testing.assert_array_equal(features(frame, "rsu"), frame.benign["car-2"].tensors["features"])


def test_elsewhere_is_the_same_frame_of_the_next_scene(detector):
    other = another_scene(Synthetic(), "test", SCENE)
    assert other == IntersectionScene(5)
    assert another_scene(Synthetic(), "test", IntersectionScene(999)) == IntersectionScene(0)
    assert another_scene(Synthetic(), "test", IntersectionScene(10_000)) is None
    frame = Encounters(detector, SCENE, elsewhere=other).sequence(2, "elsewhere", ["car-3"])[1]
    view = other.frame(1).views["car-3"]
    np.testing.assert_array_equal(features(frame, "car-3"), detector.encode(view.points, view.pose).tensors["features"])
    assert foreign_views(detector, other)("nobody", 0) is not None  # somebody else's view will do
    (honest,) = Encounters(detector, SCENE).sequence(1, "elsewhere", ["car-3"])
    assert not honest.attackers  # there is no other scene


def test_a_fleet_remembers_for_each_ego(detector):
    fleet = Fleet(SCENE, detector, 2, 1, load_campaign("ghost"), seed=0)
    first, second = zip(*(fleet.sense(index) for index in (0, 1)), strict=True)
    for before, now in (first, second):
        assert before.lies
        assert told(before) != told(now) or np.array_equal(before.message.pose, now.message.pose)
        stands = [np.linalg.inv(frame.message.pose) for frame in (before, now)]
        places = [
            np.linalg.inv(pose) @ [*frame.lies[0].box[:2], 0, 1]
            for pose, frame in zip(stands, (before, now), strict=True)
        ]
        np.testing.assert_allclose(places[0][:2], places[1][:2], atol=1e-6)


def test_a_fleet_replays_what_was_overheard_before_it_struck(detector):
    fleet = Fleet(SCENE, detector, 1, 1, load_campaign("stale@asleep"), seed=0)
    frames = [fleet.sense(index)[0] for index in range(12)]
    (attacker,) = fleet.attackers
    assert [bool(frame.attackers) for frame in frames] == [False] * 10 + [True] * 2
    sent = frames[11].sent[attacker].tensors["features"]
    np.testing.assert_array_equal(sent, frames[6].benign[attacker].tensors["features"])


@pytest.mark.parametrize("name", ["ghost", "stale", "elsewhere"])
def test_a_stretch_of_calibration_has_a_memory_of_its_own(name, detector):
    scenes = [IntersectionScene(1000), IntersectionScene(1001)]
    trial = Trial({name: load_campaign(name).attack}, [1])
    stretches = list(validation_stretches(detector, scenes, trial, np.random.default_rng(0)))
    assert [kind for kind, _ in stretches] == [None, name] * 2
    for _, (_, later) in stretches[1::2]:
        assert later.attackers
