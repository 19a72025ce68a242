import numpy as np
import pytest
import torch
from torch.nn import functional

from robosac.boxes import from_world, pose_matrix
from robosac.detectors.warp import corners, gathered, sampling_matrices, sampling_matrix, warp
from robosac.testimony import planar

CELLS, HALF = 32, 32.0


def blob(x, y):
    """A map with a smooth bump at (x, y) metres; rows along +y, columns along +x."""
    axis = -HALF + 2.0 * (np.arange(CELLS) + 0.5)
    ys, xs = np.meshgrid(axis, axis, indexing="ij")
    return torch.from_numpy(np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / 18.0).astype(np.float32))[None, None]


def centre(features):
    axis = torch.from_numpy(-HALF + 2.0 * (np.arange(CELLS) + 0.5)).float()
    weight = features[0, 0] / features.sum()
    return float((weight.sum(0) * axis).sum()), float((weight.sum(1) * axis).sum())


def test_a_thing_lands_where_the_ego_has_it():
    ego, teammate = pose_matrix(3.0, -8.0, 1.7, 0.7), pose_matrix(-6.0, 2.0, 5.0, -2.1)
    thing = np.array([[1.0, 4.0, 1.0, 1.0, 0.0]])
    seen, expected = from_world(thing, teammate)[0], from_world(thing, ego)[0]
    matrix = torch.from_numpy(sampling_matrix(ego, teammate, HALF)).float()[None]
    x, y = centre(warp(blob(seen[0], seen[1]), matrix))
    np.testing.assert_allclose([x, y], expected[:2], atol=0.15)


@pytest.mark.parametrize("mirrored", [False, True])
def test_cells_gathered_are_what_warping_gives(mirrored, rng):
    """Also of maps that are no squares, at their rims, and of a sender that is far away."""
    features = torch.from_numpy(rng.normal(size=(4, 5, 12, 20))).float()
    poses = [
        pose_matrix(*place) for place in ((-6.0, 2.0, 5.0, -2.1), (3.0, -8.0, 1.7, 0.7), (9, 9, 0, 1), (1e9, 5, 0, 1))
    ]
    matrices = sampling_matrices(planar(pose_matrix(3.0, -8.0, 1.7, 0.7), poses), HALF, mirrored)
    cells, shares = corners(matrices, 12, 20)
    assert (int(cells.min()), int(cells.max())) == (0, 12 * 20 - 1)
    by_cell = features.contiguous(memory_format=torch.channels_last)
    found, expected = gathered(by_cell, cells, shares), warp(features, torch.from_numpy(matrices).float())
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert float(found[2].abs().max()) > 0.5
    assert float(found[3].abs().max()) == 0.0
    assert found.is_contiguous(memory_format=torch.channels_last)


def test_places_are_those_of_torch():
    matrices = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 2, 3)))
    features = torch.arange(12.0 * 20, dtype=torch.float64).reshape(1, 1, 12, 20).repeat(3, 1, 1, 1)
    grid = functional.affine_grid(matrices, [3, 1, 12, 20], align_corners=False)
    expected = functional.grid_sample(features, grid, align_corners=False)
    np.testing.assert_allclose(warp(features, matrices), expected, atol=1e-9)


def test_the_own_frame_is_left_as_it_is():
    pose = pose_matrix(3.0, -8.0, 1.7, 0.7)
    features = blob(5.0, -9.0)
    moved = warp(features, torch.from_numpy(sampling_matrix(pose, pose, HALF)).float()[None])
    np.testing.assert_allclose(moved, features, atol=1e-5)


def test_how_high_tilted_sensors_say_they_are_moves_nothing():
    """One of them counts metres from the ground, and the other from the sea."""
    tilt = np.eye(4)
    tilt[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(0.05), np.sin(0.05), -np.sin(0.05), np.cos(0.05)
    ego, teammate = (pose_matrix(*place) @ tilt for place in ((3.0, -8.0, 1.7, 0.7), (-6.0, 2.0, 5.0, -2.1)))
    expected = sampling_matrix(ego, teammate, HALF)
    teammate[2, 3] += 100.0
    np.testing.assert_allclose(sampling_matrix(ego, teammate, HALF), expected, atol=1e-9)
    np.testing.assert_allclose(planar(ego, [teammate])[0, :2, 2], HALF * expected[:, 2], atol=1e-9)


def test_outside_the_teammates_map_there_is_nothing():
    far = pose_matrix(500.0, 0.0, 1.7, 0.0)
    moved = warp(torch.ones(1, 1, CELLS, CELLS), torch.from_numpy(sampling_matrix(np.eye(4), far, HALF)).float()[None])
    assert float(moved.abs().max()) == 0.0
