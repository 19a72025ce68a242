"""Occupancy grids seen from above, from LiDAR returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from robosac.boxes import FloatArray

AREA_M = 32.0
CELL_M = 0.5
GRID = int(2 * AREA_M / CELL_M)
HEIGHT_EDGES_M = (0.25, 0.75, 1.25, 1.75, 2.5)
LAYERS = len(HEIGHT_EDGES_M) + 1


def occupancy(points: FloatArray, sensor_height: float) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Which cells hold a return.

    Parameters
    ----------
    points : (P, 3+) ndarray
        Returns in the sensor's frame, metres. Those that are not finite are no returns.
    sensor_height : float
        Above ground, metres. Layers are heights above ground; the lowest (below 0.25 m) holds the ground itself.

    Returns
    -------
    (6, 128, 128) uint8 ndarray
        0 or 1; layer, row (+y), column (+x); +-32 m in cells of 0.5 m.

    Raises
    ------
    ValueError
        If the points are not numbers of that shape.
    """
    x, y, z = as_points(points).T[:3]
    column, row = np.floor((x + AREA_M) / CELL_M), np.floor((y + AREA_M) / CELL_M)
    inside = (column >= 0) & (column < GRID) & (row >= 0) & (row < GRID) & np.isfinite(z)
    column, row = column[inside].astype(np.int64), row[inside].astype(np.int64)
    layer = np.digitize(z[inside] + sensor_height, HEIGHT_EDGES_M)
    grid = np.zeros((LAYERS, GRID, GRID), dtype=np.uint8)
    grid[layer, row, column] = 1
    return grid


def as_points(points: Any) -> FloatArray:
    """Points as an array (P, 3+); an empty list is no point. `ValueError` if they are not numbers of that shape."""
    array = np.asarray(points)
    if array.shape == (0,):
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "iuf":
        raise ValueError(f"points must be numbers of shape (P, 3+), got {array.dtype} of {array.shape}")
    return array
