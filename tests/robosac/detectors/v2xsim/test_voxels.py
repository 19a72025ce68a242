import numpy as np
import pytest
import torch

from robosac.detectors.v2xsim.voxels import ROADSIDE_BOTTOM_M, from_indices, occupancy, pack, unpack


@pytest.mark.parametrize(
    ("point", "cell"),
    [
        ((0.1, 0.1, 0.1), (128, 127, 8)),
        ((-31.9, -31.9, -2.9), (0, 255, 0)),
        ((31.9, 31.9, 1.9), (255, 0, 12)),
        ((10.1, -20.1, -0.1), (47, 87, 7)),
    ],
)
def test_a_return_fills_its_voxel(point, cell):
    assert np.argwhere(occupancy(np.array([point]))).tolist() == [list(cell)]


def test_what_lies_outside_does_not_count():
    outside = [[32.1, 0, 0], [0, -32.1, 0], [0, 0, -3.1], [0, 0, 2.1], [np.nan, 0, 0]]
    assert not occupancy(np.array(outside)).any()


def test_a_roadside_unit_looks_farther_down():
    assert np.argwhere(occupancy(np.array([[0.1, 0.1, -7.9]]), ROADSIDE_BOTTOM_M))[0, 2] == 0
    assert np.argwhere(occupancy(np.array([[0.1, 0.1, -3.1]]), ROADSIDE_BOTTOM_M))[0, 2] == 12


def test_indices_follow_the_sensors_axes():
    grid = from_indices(np.array([[3, 10, 2]]))
    assert np.argwhere(grid).tolist() == [[10, 252, 2]]
    dense = np.zeros((256, 256, 13), dtype=bool)
    dense[3, 10, 2] = True
    np.testing.assert_array_equal(grid, np.rot90(dense, k=3))


def test_packing_loses_nothing(rng):
    grid = rng.random((256, 256, 13)) < 0.1
    packed = pack(grid)
    assert packed.shape == (256, 416)
    assert packed.dtype == np.uint8
    np.testing.assert_array_equal(unpack(torch.from_numpy(packed)[None])[0].numpy(), grid)
