"""Occupancy grids of the V2X-Sim layout, and their bit-packed form in messages.

A grid is (256, 256, 13): row (+y), column (*minus* x), layer (+z), in the sensor's frame, cells of 0.25 x 0.25 x 0.4 m
over +-32 m. Layers begin at whole multiples of 0.4 m, so a vehicle's lowest and highest, cut off at -3 m and
2 m, are thinner than the others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from robosac.boxes import BoolArray, FloatArray
from robosac.detectors.v2xsim.network import GRID, LAYERS
from robosac.detectors.voxels import as_points

AREA_M = 32.0
CELL_M = 0.25
LAYER_M = 0.4
BOTTOM_M = -3.0
ROADSIDE_BOTTOM_M = -8.0
"""Of a roadside unit's grid, whose sensor stands that much higher."""
DEPTH_M = 5.0
_CELL_M = np.array([CELL_M, CELL_M, LAYER_M])
PACKED_SHAPE = (GRID, GRID * LAYERS // 8)

ByteArray = np.ndarray[tuple[Any, ...], np.dtype[np.uint8]]


def occupancy(points: FloatArray, bottom_m: float = BOTTOM_M) -> BoolArray:
    """Which voxels hold a return.

    Parameters
    ----------
    points : (P, 3+) ndarray
        Returns in the sensor's frame, metres.
    bottom_m : float
        Lowest height that counts, sensor's frame; the grid reaches 5 m up from there.

    Returns
    -------
    (256, 256, 13) bool ndarray

    Raises
    ------
    ValueError
        If the points are not numbers of that shape.
    """
    low, high = _ends(bottom_m)
    xyz = as_points(points)[:, :3].astype(np.float64)
    xyz = xyz[np.all((xyz > low) & (xyz < high), axis=1)]
    return from_indices((np.floor(xyz / _CELL_M) - np.floor(low / _CELL_M)).astype(np.int64))


def from_indices(indices: np.ndarray[Any, np.dtype[Any]]) -> BoolArray:
    """The grid of a list of occupied voxels.

    Parameters
    ----------
    indices : (K, 3) int ndarray
        Along +x, +y, +z of the sensor, as V2X-Sim samples list them; each within (256, 256, 13).

    Returns
    -------
    (256, 256, 13) bool ndarray
    """
    grid = np.zeros((GRID, GRID, LAYERS), dtype=np.bool_)
    grid[indices[:, 1], GRID - 1 - indices[:, 0], indices[:, 2]] = True
    return grid


def centres(indices: np.ndarray[Any, np.dtype[Any]], bottom_m: float = BOTTOM_M) -> FloatArray:
    """Points (K, 3) in the middle of voxels (K, 3) that are listed as for `from_indices`.

    `occupancy` of these points is the grid of these voxels.
    """
    low, high = _ends(bottom_m)
    begin = (np.floor(low / _CELL_M) + indices) * _CELL_M
    middle: FloatArray = (np.maximum(begin, low) + np.minimum(begin + _CELL_M, high)) / 2
    return middle


def _ends(bottom_m: float) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest x, y, z of a grid."""
    return np.array([-AREA_M, -AREA_M, bottom_m]), np.array([AREA_M, AREA_M, bottom_m + DEPTH_M])


def pack(grid: BoolArray) -> ByteArray:
    """A grid as bits (256, 416): each row's columns and layers in C order, the first in a byte's highest bit."""
    return np.packbits(grid.reshape(GRID, -1), axis=1)


def unpack(packed: torch.Tensor) -> torch.Tensor:
    """The grids (n, 256, 256, 13), 0 or 1 as uint8, of packed bits (n, 256, 416), uint8."""
    bits = packed[..., None] >> torch.arange(7, -1, -1, dtype=torch.uint8, device=packed.device) & 1
    return bits.reshape(-1, GRID, GRID, LAYERS)
