"""Boxes as other programs write them."""

import numpy as np


def from_corners(points):
    """Boxes (n, 5) from the corners (n, 4, 2) of rectangles, in order around each; the first side is the length."""
    points = np.asarray(points, dtype=np.float64)
    centre = points.mean(axis=1)
    along, across = points[:, 1] - points[:, 0], points[:, 2] - points[:, 1]
    yaw = np.arctan2(along[:, 1], along[:, 0])
    return np.column_stack([centre, np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1), yaw])
