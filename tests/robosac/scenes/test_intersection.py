import numpy as np
import pytest

from robosac.boxes import corners, from_world, pairwise_iou, pose_matrix
from robosac.scenes import AgentView, IntersectionScene, Lidar, SceneFrame
from robosac.scenes.splits import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from robosac.scenes.world import LANES_M, PARKED_ROW_M

SEEDS = range(6)


def test_the_same_seed_gives_the_same_frame_whatever_came_before():
    scene = IntersectionScene(5)
    for _ in map(scene.frame, range(3)):
        pass
    first, second = scene.frame(7), IntersectionScene(5).frame(7)
    np.testing.assert_array_equal(first.vehicles, second.vehicles)
    for name in scene.agents:
        np.testing.assert_array_equal(first.views[name].points, second.views[name].points)
    assert not np.array_equal(first.vehicles, IntersectionScene(6).frame(7).vehicles[: len(first.vehicles)])


def test_splits_share_no_seed():
    assert not set(TEST_SEEDS) & set(VALIDATION_SEEDS)
    assert not set(TRAINING_SEEDS) & (set(TEST_SEEDS) | set(VALIDATION_SEEDS))


@pytest.mark.parametrize("seed", SEEDS)
def test_vehicles_keep_apart_and_to_the_roads(seed):
    scene = IntersectionScene(seed)
    for index in (0, 12, 24):
        vehicles = scene.frame(index).vehicles
        overlap = pairwise_iou(vehicles, vehicles)
        np.fill_diagonal(overlap, 0.0)
        assert overlap.max() < 1e-9
        buildings = scene.traffic.buildings[:, :5]
        assert pairwise_iou(vehicles, buildings).max() < 1e-9


def test_traffic_flows_at_5_hz():
    scene = IntersectionScene(1)
    first, second = scene.frame(0).vehicles, scene.frame(1).vehicles
    moved = np.hypot(*(second - first)[:, :2].T)
    moving = moved > 1e-9
    assert moving.any()
    assert not moving.all()
    steps = moved[moving & (moved < 5)]  # those that left at one end enter at the other
    assert steps.min() >= 4.0 * 0.2 - 1e-9
    assert steps.max() <= 9.0 * 0.2 + 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_agents_stay_near_the_centre_and_poses_are_exact(seed):
    scene = IntersectionScene(seed)
    for index in (0, 12, 24):
        frame = scene.frame(index)
        assert set(frame.views) == set(scene.agents)
        for name, view in frame.views.items():
            assert np.hypot(*view.pose[:2, 3]) < 40.0
            np.testing.assert_allclose(view.pose[:3, :3] @ view.pose[:3, :3].T, np.eye(3), atol=1e-12)
            if name in frame.carriers:
                carrier = frame.vehicles[frame.carriers[name]]
                np.testing.assert_allclose(from_world(carrier[None], view.pose)[0, [0, 1, 4]], 0.0, atol=1e-9)
        assert "rsu" not in frame.carriers


def test_returns_lie_on_surfaces():
    scene = IntersectionScene(2, lidar=Lidar(noise_m=0.0, dropout=0.0))
    frame = scene.frame(0)
    solid = np.vstack([frame.vehicles, scene.traffic.buildings[:, :5]])
    for view in frame.views.values():
        world = view.points @ view.pose[:3, :3].T + view.pose[:3, 3]
        standing = world[world[:, 2] > 0.02]
        grown = solid + [[0, 0, 0.05, 0.05, 0]]
        shrunk = solid - [[0, 0, 0.05, 0.05, 0]]
        assert inside(standing[:, :2], grown).any(axis=1).all()
        walls = standing[~inside(standing[:, :2], shrunk).any(axis=1)]
        assert len(walls) > 0.5 * len(standing)  # the rest are roofs


def inside(points, boxes):
    offset = points[:, None] - boxes[None, :, :2]
    cos, sin = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    along = cos * offset[..., 0] + sin * offset[..., 1]
    across = -sin * offset[..., 0] + cos * offset[..., 1]
    return (np.abs(along) <= boxes[:, 2] / 2) & (np.abs(across) <= boxes[:, 3] / 2)


def test_the_world_hides_what_collaboration_reveals():
    shares, counts = [], []
    for seed in range(12):
        frame = IntersectionScene(seed).frame(10)
        for ego in frame.carriers:
            truth = frame.truth(ego)
            boxes, index = frame.nearby(ego)
            own = boxes[frame.views[ego].hits[index] >= 6]
            shares.append(len(own) / len(truth))
            counts.append(len(truth))
    assert 0.55 < np.mean(shares) < 0.80
    assert 18 < np.mean(counts) < 35


def test_truth_is_in_the_egos_frame_and_without_the_ego():
    frame = IntersectionScene(3).frame(0)
    truth = frame.truth("car-1")
    assert np.abs(truth[:, :2]).max() <= 31.0
    assert np.hypot(truth[:, 0], truth[:, 1]).min() > 2.0


def test_a_vehicle_is_true_from_six_returns_of_one_agent_on():
    vehicles = np.array(
        [[0, 0, 4, 2, 0], [10, 0, 4, 2, 0], [0, 10, 4, 2, 0], [-10, 0, 4, 2, 0], [50, 0, 4, 2, 0]], float
    )
    here, there = pose_matrix(0, 0, 1.7, 0), pose_matrix(5, 5, 1.7, 0)
    views = {
        "ego": AgentView(here, np.empty((0, 3)), np.array([9, 3, 6, 0, 9])),
        "mate": AgentView(there, np.empty((0, 3)), np.array([9, 5, 0, 0, 9])),
    }
    truth = SceneFrame(0, vehicles, views, {"ego": 0}).truth("ego")
    np.testing.assert_allclose(truth[:, :2], [[0, 10]], atol=1e-12)


def test_a_scene_may_have_other_agents_than_six():
    frame = IntersectionScene(0, car_agents=2).frame(0)
    assert list(frame.views) == ["car-1", "car-2", "rsu"]


@pytest.mark.parametrize(
    "call", [lambda: IntersectionScene(0).frame(-1), lambda: IntersectionScene(0, car_agents=0).frame(0)]
)
def test_nonsense_is_refused(call):
    with pytest.raises(ValueError, match="must"):
        call()


def test_lanes_do_not_reach_the_parked_rows():
    assert max(LANES_M) + 1.3 < PARKED_ROW_M - 1.0
    assert corners(np.array([[0, PARKED_ROW_M, 5, 2, 0]]))[0, :, 1].max() < 10.5
