import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robosac.boxes import pose_matrix
from robosac.interfaces.opv2v import world_to_x, x_to_world


def published(x, y, z, roll, yaw, pitch):
    """Entry by entry, as the data set's authors give the matrix."""
    (cr, cy, cp), (sr, sy, sp) = (f(np.radians([roll, yaw, pitch])) for f in (np.cos, np.sin))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


place = st.floats(-1e4, 1e4)
turn = st.floats(-180, 180)


@given(place, place, place, turn, turn, turn)
def test_the_matrix_is_the_published_one(x, y, z, roll, yaw, pitch):
    np.testing.assert_allclose(
        x_to_world([x, y, z, roll, yaw, pitch]), published(x, y, z, roll, yaw, pitch), atol=1e-12
    )


@given(place, place, place, st.floats(-40, 40), turn, st.floats(-40, 40))
def test_there_and_back(x, y, z, roll, yaw, pitch):
    matrix = x_to_world([x, y, z, roll, yaw, pitch])
    again = world_to_x(matrix)
    np.testing.assert_allclose(again[[0, 1, 2, 3, 5]], [x, y, z, roll, pitch], atol=1e-6)
    np.testing.assert_allclose(x_to_world(again), matrix, atol=1e-9)


def test_on_flat_ground_it_is_the_pose_that_scenes_make():
    np.testing.assert_allclose(x_to_world([3, -4, 1.9, 0, 30, 0]), pose_matrix(3, -4, 1.9, np.radians(30)), atol=1e-12)
    np.testing.assert_allclose(
        world_to_x(pose_matrix(3, -4, 1.9, np.radians(-150))), [3, -4, 1.9, 0, -150, 0], atol=1e-9
    )


@pytest.mark.parametrize("pose", [[1, 2, 3], [1, 2, 3, 4, 5, np.nan], [[1, 2, 3, 4, 5, 6]]])
def test_what_is_no_pose_of_opv2v_is_refused(pose):
    with pytest.raises(ValueError, match="six finite numbers"):
        x_to_world(pose)


def test_what_is_no_matrix_is_refused():
    with pytest.raises(ValueError, match="rigid"):
        world_to_x(2 * np.eye(4))
    with pytest.raises(ValueError, match="4 x 4"):
        world_to_x(np.eye(3))
