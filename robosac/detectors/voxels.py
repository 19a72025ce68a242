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
    points : (P, 3) ndarray
        Returns in the sensor's frame, metres.
    sensor_height : float
        Above ground, metres. Layers are heights above ground; the lowest (below 0.25 m) holds the ground itself.

    Returns
    -------
    (6, 128, 128) uint8 ndarray
        0 or 1; layer, row (+y), column (+x); +-32 m in cells of 0.5 m.
    """
    column = np.floor((points[:, 0] + AREA_M) / CELL_M).astype(np.int64)
    row = np.floor((points[:, 1] + AREA_M) / CELL_M).astype(np.int64)
    layer = np.digitize(points[:, 2] + sensor_height, HEIGHT_EDGES_M)
    inside = (column >= 0) & (column < GRID) & (row >= 0) & (row < GRID)
    grid = np.zeros((LAYERS, GRID, GRID), dtype=np.uint8)
    grid[layer[inside], row[inside], column[inside]] = 1
    return grid
