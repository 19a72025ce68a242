"""Moving a feature map from one sensor's frame to another's."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray


def sampling_matrix(ego_pose: FloatArray, pose: FloatArray, half_extent_m: float, mirrored: bool = False) -> FloatArray:
    """Where to look in a teammate's map for each place of the ego's.

    Parameters
    ----------
    ego_pose, pose : (4, 4) ndarray
        world_from_sensor of the ego and of the teammate; their motion in the plane counts, and not how high they say
        they are.
    half_extent_m : float
        Maps cover +- this, in metres, in both directions.
    mirrored : bool
        Columns of the maps run along *minus* x, not along x; rows run along y.

    Returns
    -------
    (2, 3) float64 ndarray
        For `torch.nn.functional.affine_grid`: normalised ego coordinates (x, y) to normalised teammate coordinates.
    """
    level = ego_pose.copy()
    level[2, 3] = pose[2, 3]  # seen from a tilted sensor, what is said to be higher would lie farther
    relative = np.linalg.inv(pose) @ level
    matrix = relative[:2, [0, 1, 3]].copy()
    matrix[:, 2] /= half_extent_m
    if mirrored:
        matrix[[0, 0, 1], [1, 2, 0]] *= -1.0
    return matrix


def warp(features: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
    """Resample maps (n, C, H, W) by matrices (n, 2, 3): bilinear, zero outside."""
    grid = functional.affine_grid(matrices, list(features.shape), align_corners=False)
    return functional.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
