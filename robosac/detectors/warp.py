"""Moving a feature map from one sensor's frame to another's."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from torch.nn import functional

from robosac.boxes import FloatArray
from robosac.testimony import planar


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
    matrix: FloatArray = sampling_matrices(planar(ego_pose, [pose]), half_extent_m, mirrored)[0]
    return matrix


def sampling_matrices(from_ego: FloatArray, half_extent_m: float, mirrored: bool = False) -> FloatArray:
    """As `sampling_matrix`, (n, 2, 3), of the ego's plane in each teammate's frame (n, 3, 3)."""
    matrices = from_ego[:, :2].copy()
    matrices[:, :, 2] /= half_extent_m
    if mirrored:
        matrices[:, [0, 0, 1], [1, 2, 0]] *= -1.0
    return matrices


def warp(features: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
    """Resample maps (n, C, H, W) by matrices (n, 2, 3): bilinear, zero outside."""
    grid = _places(matrices, *features.shape[-2:]).permute(0, 2, 3, 1)
    return functional.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def corners(matrices: FloatArray, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The four cells of a teammate's map between which each cell of the ego's lies, and the share of each.

    Parameters
    ----------
    matrices : (n, 2, 3) ndarray
        As `sampling_matrices` returns them.
    height, width : int
        Cells of a map.

    Returns
    -------
    cells : (n, H W, 4) int32 tensor
        Rows of cells one after the other; what lies outside the map is another cell with a share of 0.
    shares : (n, H W, 4) float32 tensor
    """
    size = np.array([[width], [height]], dtype=np.float32)
    x, y = ((2 * np.arange(cells, dtype=np.float32) + 1) / cells - 1 for cells in (width, height))
    scaled = matrices.astype(np.float32) * (size / 2)
    along_x = scaled[:, :, :1] * x + (scaled[:, :, 2:] + (size - 1) / 2)
    places = (along_x[:, :, None] + (scaled[:, :, 1:2] * y)[..., None]).reshape(-1, 2, height * width)
    places = np.minimum(np.maximum(places, -1), size)  # far outside they are no whole numbers any more
    last, first = size.astype(np.int32) - 1, np.floor(places)
    beyond, first = places - first, first.astype(np.int32)
    near = np.minimum(np.maximum(first, 0), last), np.minimum(first + 1, last)
    share = (1 - beyond) * ((first >= 0) & (first <= last)), beyond * (first < last)
    cells = np.empty((len(matrices), height * width, 4), dtype=np.int32)
    shares = np.empty(cells.shape, dtype=np.float32)
    for corner, (i, j) in enumerate(product((0, 1), (0, 1))):
        np.add(near[i][:, 1] * width, near[j][:, 0], out=cells[..., corner])
        np.multiply(share[i][:, 1], share[j][:, 0], out=shares[..., corner])
    return torch.from_numpy(cells), torch.from_numpy(shares)


def gathered(features: torch.Tensor, cells: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
    """What `warp` does, several times faster, of maps with the channels of a cell side by side, given their `corners`.

    So they come out, too (n, C, H, W). Their numbers have to be finite.
    """
    count, channels, height, width = features.shape
    table = features.permute(0, 2, 3, 1).reshape(-1, channels)
    first = torch.arange(0, len(table), height * width, dtype=cells.dtype, device=cells.device)
    which = (cells + first[:, None, None]).flatten(0, 1)
    warped = functional.embedding_bag(which, table, mode="sum", per_sample_weights=shares.flatten(0, 1))
    return warped.view(count, height, width, channels).permute(0, 3, 1, 2)


def _places(matrices: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Where to look for each cell of a map, by matrices (n, 2, 3): x and y (n, 2, H, W), normalised.

    It is what `torch.nn.functional.affine_grid` finds, which takes longer than it does to look there.
    """
    x, y = (
        (2 * torch.arange(size, dtype=matrices.dtype, device=matrices.device) + 1) / size - 1
        for size in (width, height)
    )
    along_x, along_y = matrices[:, :, :1] * x + matrices[:, :, 2:], matrices[:, :, 1:2] * y
    return along_x[:, :, None] + along_y[..., None]
