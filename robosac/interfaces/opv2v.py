"""Poses as the data set OPV2V writes them: six numbers, lengths in metres and angles in degrees.

R. Xu et al., "OPV2V: An Open Benchmark Dataset and Fusion Pipeline for Perception with Vehicle-to-Vehicle
Communication", ICRA 2022. DAIR-V2X and V2XSet as OpenCOOD reads them, and V2V4Real, use the same convention.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robosac.boxes import FloatArray, pose_fault


def x_to_world(pose: Sequence[float] | FloatArray) -> FloatArray:
    """The matrix world_from_sensor of a pose of OPV2V.

    The rotation is R_z(yaw) R_y(-pitch) R_x(-roll), each a turn by the right-hand rule about a fixed axis of the
    world, the last factor first.

    Parameters
    ----------
    pose : sequence of 6 floats
        x, y, z in metres, then roll, yaw, pitch in degrees, in this order.

    Returns
    -------
    (4, 4) ndarray
        As a message wants it.

    Raises
    ------
    ValueError
        If these are not six finite numbers.
    """
    numbers = np.asarray(pose, dtype=np.float64)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise ValueError(f"a pose of OPV2V is six finite numbers: x, y, z, roll, yaw, pitch; got {pose}")
    roll, yaw, pitch = np.radians(numbers[3:])
    matrix = np.eye(4)
    matrix[:3, :3] = _turn(2, yaw) @ _turn(1, -pitch) @ _turn(0, -roll)
    matrix[:3, 3] = numbers[:3]
    return matrix


def world_to_x(matrix: FloatArray) -> FloatArray:
    """The pose of OPV2V that `x_to_world` makes this matrix of.

    Where the pitch is 90 degrees up or down, roll and yaw turn about the same axis; roll is 0 then.

    Parameters
    ----------
    matrix : (4, 4) ndarray
        world_from_sensor.

    Returns
    -------
    (6,) ndarray
        x, y, z in metres; roll, yaw, pitch in degrees, pitch from -90 to 90.

    Raises
    ------
    ValueError
        If that is no pose.
    """
    pose = np.asarray(matrix, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"a pose must be 4 x 4 finite numbers, got shape {pose.shape}")
    if fault := pose_fault(pose):
        raise ValueError(f"a pose {fault}")
    level = np.hypot(pose[0, 0], pose[1, 0])  # the cosine of the pitch
    pitch = np.arctan2(pose[2, 0], level)
    if level > 1e-9:
        yaw, roll = np.arctan2(pose[1, 0], pose[0, 0]), np.arctan2(-pose[2, 1], pose[2, 2])
    else:
        yaw, roll = np.arctan2(-pose[0, 1], pose[1, 1]), 0.0
    return np.array([*pose[:3, 3], *np.degrees([roll, yaw, pitch])])


def _turn(axis: int, angle: float) -> FloatArray:
    """Rotation (3, 3) by the right-hand rule about x (0), y (1) or z (2); radians."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -matrix[second, first]
    return matrix
