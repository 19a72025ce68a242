import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from robosac.boxes import pairwise_iou
from robosac.scenes import SOURCES, IntersectionScene, SceneError
from robosac.scenes.drawing import draw_view
from robosac.scenes.splits import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from robosac.scenes.worlds import WORLDS, World
from robosac.scenes.worlds.car_park import CarPark
from robosac.scenes.worlds.crossing import Crossing
from robosac.scenes.worlds.highway import Highway
from robosac.scenes.worlds.roundabout import Roundabout

LAYOUTS = (Crossing, Highway, Roundabout, CarPark)
DENSITIES = ("sparse", "plain", "dense", "jammed")
TRUE_BOXES = {"crossing": (15, 40), "crossing-dense": (25, 50), "highway": (4, 20), "highway-jammed": (20, 40)}
TRUE_BOXES |= {"roundabout": (4, 25), "roundabout-dense": (8, 32), "car-park": (15, 60)}
"""Fewest and most in a frame."""
SPEEDS = {"crossing-fast": (11, 15), "highway": (22, 30), "highway-jammed": (0, 5), "roundabout": (5, 9)}
SPEEDS |= {"car-park": (1.5, 4), "crossing-jammed": (0, 2), "crossing-dense-fast": (11, 15)}


@pytest.fixture
def crossing():
    return Crossing(5)


def test_a_plain_crossing_is_the_synthetic_intersection(crossing):
    mine, other = crossing.frame(7), IntersectionScene(5).frame(7)
    np.testing.assert_array_equal(mine.vehicles, other.vehicles)
    for name in crossing.agents:
        np.testing.assert_array_equal(mine.views[name].points, other.views[name].points)


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_vehicles_overlap_neither_each_other_nor_walls(layout, density):
    for seed in range(8):
        traffic = layout(seed, density=density).traffic
        walls = traffic.buildings[:, :5]
        for time_s in (*np.arange(0.0, 5.1, 0.6), 20.2, 60.0):
            vehicles = traffic.vehicles_at(time_s)
            overlap = pairwise_iou(vehicles, vehicles)
            np.fill_diagonal(overlap, 0.0)
            assert overlap.max() < 1e-9
            assert pairwise_iou(vehicles, walls).max() < 1e-9


@pytest.mark.parametrize("name", SPEEDS)
def test_vehicles_drive_at_the_speeds_of_their_world(name):
    low, high = SPEEDS[name]
    for seed in range(4):
        traffic = World(name).scene(seed).traffic
        first, second = traffic.vehicles_at(2.0), traffic.vehicles_at(2.2)
        moved = np.hypot(*(second - first)[:, :2].T)
        turned = np.abs((second[:, 4] - first[:, 4] + np.pi) % (2 * np.pi) - np.pi)
        drives = (traffic.speed > 0) & (moved < 20)  # those that left at one end enter at the other
        assert drives.sum() > 0.8 * (traffic.speed > 0).sum()
        assert (moved[traffic.speed == 0] == 0).all()
        assert moved[drives].min() >= 0.2 * low * 0.98  # on a circle the way is longer than the chord
        assert moved[drives].max() <= 0.2 * high + 1e-9
        assert turned[drives].max() <= 0.2 * high / 8.0 + 1e-9  # nothing turns on a radius below 8 m


def test_vehicles_head_where_they_drive():
    for layout in LAYOUTS:
        traffic = layout(1).traffic
        first, second = traffic.vehicles_at(2.0), traffic.vehicles_at(2.01)
        way = (second - first)[:, :2]
        moved = np.hypot(*way.T)
        drives = (moved > 1e-6) & (moved < 1)
        heading = np.arctan2(way[:, 1], way[:, 0])[drives]
        apart = np.abs((first[drives, 4] - heading + np.pi) % (2 * np.pi) - np.pi)
        assert apart.max() < 0.12  # a vehicle is not quite straight in its lane


@pytest.mark.parametrize("name", TRUE_BOXES)
def test_every_agent_sees_something_and_the_truth_is_of_a_sensible_size(name):
    fewest, most = TRUE_BOXES[name]
    for seed in range(3):
        scene = World(name).scene(seed)
        for index in (0, 12, 24):
            frame = scene.frame(index)
            truth = frame.truth("car-1")
            assert fewest <= len(truth) <= most
            assert np.abs(truth[:, :2]).max() <= 31.0
            assert list(frame.views) == ["car-1", "car-2", "car-3", "car-4", "car-5", "rsu"]
            assert all((view.hits >= 6).any() for view in frame.views.values())
            at = np.array([view.pose[:2, 3] for view in frame.views.values()])
            apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
            assert apart[~np.eye(len(at), dtype=bool)].min() < 31.0  # two share what they see


def test_dense_traffic_hides_more():
    def seen(name):
        shares, counts = [], []
        for seed in range(10):
            frame = World(name).scene(seed).frame(10)
            _, index = frame.nearby("car-1")
            counts.append(len(frame.truth("car-1")))
            shares.append((frame.views["car-1"].hits[index] >= 6).sum() / counts[-1])
        return np.mean(counts), np.mean(shares)

    plain, dense, sparse = map(seen, ("crossing", "crossing-dense", "crossing-sparse"))
    assert 36 <= dense[0] <= 43
    assert sparse[0] < plain[0] - 8 < dense[0] - 16
    assert sparse[1] > plain[1] > dense[1] + 0.05


def test_a_sensor_has_the_beams_and_the_range_of_its_world():
    returns = {beams: len(World(f"crossing-{beams}-beams").scene(0).frame(0).views["rsu"].points) for beams in (14, 64)}
    plain = World("crossing").scene(0).frame(0).views["rsu"].points
    assert returns[14] < 0.6 * len(plain)
    assert returns[64] > 2 * len(plain)
    near = World("crossing-short-range").scene(0).frame(0).views["rsu"].points
    assert np.hypot(plain[:, 0], plain[:, 1]).max() > 50
    assert np.hypot(near[:, 0], near[:, 1]).max() < 30.5


def test_highway_agents_stay_together_while_others_come_and_go():
    traffic = Highway(2).traffic
    for time_s in (0.0, 5.0, 60.0):
        vehicles = traffic.vehicles_at(time_s)
        centre = vehicles[traffic.agent_vehicles, :2].mean(axis=0)
        assert np.hypot(*(vehicles[:, :2] - centre).T).max() < 300.0
    start, soon, late = (traffic.vehicles_at(time_s)[traffic.agent_vehicles, :2] for time_s in (0.0, 5.0, 60.0))
    assert np.hypot(*(soon - start).T).min() > 5 * 21.9
    assert np.hypot(*(late - start).T).min() > 60 * 21.9 - 280.0


@pytest.mark.parametrize("name", WORLDS)
def test_every_world_is_a_source_that_can_be_sent_and_made_again(name):
    source = SOURCES.make(f"world:{name}")
    assert source.name == f"world:{name}"
    there = pickle.loads(pickle.dumps(source))
    scene, again = source.scenes("validation")[3], there.scenes("validation")[3]
    assert scene.number == again.number == 1003
    pickle.dumps(scene)
    scene.frame(1)
    first, second = scene.frame(2), again.frame(2)
    assert list(first.views) == list(second.views)
    assert scene.egos[0] in first.views
    for one, other in zip(first.views.values(), second.views.values(), strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.pose, other.pose)
    np.testing.assert_array_equal(first.truth("car-1"), second.truth("car-1"))


def test_scenes_of_one_purpose_serve_no_other():
    world = World("highway")
    numbers = {split: [scene.number for scene in world.scenes(split)] for split in ("test", "validation")}
    assert numbers == {"test": list(TEST_SEEDS), "validation": list(VALIDATION_SEEDS)}
    assert [scene.number for scene in world.training_scenes()[:2]] == list(TRAINING_SEEDS[:2])
    assert len(world.training_scenes()) == len(TRAINING_SEEDS)
    assert world.scene(10_000).number == world.training_scenes()[0].number
    with pytest.raises(IndexError):
        world.scenes("test")[1000]


@pytest.mark.parametrize("text", ["world:nonesuch", "world:", "world"])
def test_the_worlds_are_listed_to_who_asks_for_another(text):
    with pytest.raises(SceneError, match=re.escape(", ".join(WORLDS))):
        SOURCES.make(text)


def test_the_page_on_worlds_lists_them_all():
    page = Path(__file__).parents[3] / "docs" / "synthetic-world.md"
    table = page.read_text().partition("## Other worlds")[2].partition("## The detector")[0]
    assert re.findall(r"^\| `([\w-]+)` \|", table, re.MULTILINE) == list(WORLDS)


def test_nonsense_is_refused():
    with pytest.raises(SceneError, match="must not be negative"):
        World("crossing").scene(-1)
    with pytest.raises(ValueError, match="must"):
        Highway(0).frame(-1)
    for layout in LAYOUTS:
        with pytest.raises(ValueError, match="at least 1"):
            layout(0, car_agents=0).frame(0)
        with pytest.raises(ValueError, match="never 70 cars"):
            layout(0, car_agents=70).frame(0)


@pytest.mark.parametrize("name", ["highway", "roundabout", "car-park"])
def test_a_frame_can_be_drawn(name, tmp_path):
    frame = World(name).scene(3).frame(12)
    seen, hidden = draw_view(frame, "car-1", tmp_path / "view.png")
    assert seen + hidden == len(frame.truth("car-1"))
    assert imread(tmp_path / "view.png").std() > 0.01
