"""Places of a scan for a witness to learn from: where vehicles are, where none is, and how well each was observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robosac.boxes import BoolArray, FloatArray, pairwise_iou
from robosac.scenes import View

STANDARD = (4.5, 1.9, 1.55)
"""Length, width and height of the car that might stand in a place, metres."""
OBSERVED_HITS = 6
"""A place is observed if so many returns would have come from a car that stood there."""
FREE_PLACES = 48
"""Free places drawn of a scan, but for those near vehicles."""
LANE_SHARE = 0.7
"""Share of them on the line along which some vehicle heads; the others are anywhere."""
LANE_REACH_M = 24.0
LANE_JITTER_M = 0.5
CLEARANCE_M = 0.5
"""These keep so far from all vehicles."""
NEAR_PLACES = 16
"""Further free places drawn of a scan, near vehicles: there a witness has to tell the vehicle from a second one."""
NEAR_REACH_M = (6.5, 4.5)
"""They are centred at most so far along and across from a vehicle."""
NEAR_CLEARANCE_M = 0.2
"""And keep so far from all."""
JITTER_M = 0.25
"""Standard deviation of where a place is asked about beside where it is, along both axes."""
OWN_BODY_M = 3.5
"""Nothing is asked about so close to the sensor."""
GROUND_QUANTILE = 0.1
"""Share of the returns that lie at the ground or below it, at least."""


@dataclass(frozen=True)
class Places:
    """Places of one scan, in the sensor's frame."""

    at: FloatArray
    """(n, 2): x, y, metres."""
    vehicle: FloatArray
    """(n,): 1 where a vehicle is centred, 0 where none is."""
    hits: FloatArray
    """(n,): returns that would have come from a car there."""
    box: FloatArray
    """(n, 5): the vehicle; zeros where there is none."""

    @property
    def observed_vehicles(self) -> BoolArray:
        """Which of them (n,) are vehicles that were observed."""
        return (self.vehicle > 0) & (self.hits >= OBSERVED_HITS)


def places(view: View, truth: FloatArray, half_extent_m: float, rng: np.random.Generator) -> Places:
    """Draw places of what one agent senses.

    Parameters
    ----------
    view : View
    truth : (n, 5) ndarray
        All vehicles around it, its frame.
    half_extent_m : float
        Only places within +- this are of interest, along both axes.
    rng : numpy.random.Generator
    """
    inside = (np.abs(truth[:, :2]) < half_extent_m - 1).all(axis=1) & (np.hypot(*truth[:, :2].T) > OWN_BODY_M)
    vehicles, free = truth[inside], _free(truth, half_extent_m, rng)
    boxes = np.concatenate(
        [vehicles, np.column_stack([free[:, :2], np.tile(STANDARD[:2], (len(free), 1)), free[:, 2]])]
    )
    is_vehicle = np.arange(len(boxes)) < len(vehicles)
    return Places(
        at=boxes[:, :2] + rng.normal(0.0, JITTER_M, (len(boxes), 2)),
        vehicle=is_vehicle.astype(np.float64),
        hits=hits(view, boxes).astype(np.float64),
        box=np.where(is_vehicle[:, None], boxes, 0.0),
    )


def hits(view: View, boxes: FloatArray) -> FloatArray:
    """How many returns (n,) of a scan would have come from cars at these boxes (n, 5), sensor's frame.

    A return counts if its ray, up to the return itself or a little beyond, meets the box of a car `STANDARD` high that
    stands on the ground. So it does if it came from something in the box, or behind it.
    """
    points = np.asarray(view.points, dtype=np.float64)
    if not len(points) or not len(boxes):
        return np.zeros(len(boxes))
    ground = float(np.quantile(points[:, 2], GROUND_QUANTILE))
    reach = np.hypot(points[:, 0], points[:, 1])
    slope = points[:, 2] / np.maximum(reach, 1e-9)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    counted = np.zeros(len(boxes))
    for index, (x, y, length, width, yaw) in enumerate(boxes[:, :5]):
        far, radius = np.hypot(x, y), np.hypot(length, width) / 2
        apart = np.abs((azimuth - np.arctan2(y, x) + np.pi) % (2 * np.pi) - np.pi)
        near = np.flatnonzero((apart < np.arcsin(min(1.0, radius / max(far, radius)))) & (reach > far - radius))
        cos, sin = np.cos(azimuth[near] - yaw), np.sin(azimuth[near] - yaw)
        start = -(np.cos(yaw) * x + np.sin(yaw) * y), np.sin(yaw) * x - np.cos(yaw) * y
        enter, leave = _slab(start[0], cos, length / 2), _slab(start[1], sin, width / 2)
        first = np.maximum(enter[0], leave[0])
        last = np.minimum(np.minimum(enter[1], leave[1]), reach[near] + 0.2)
        low, high = slope[near] * first - ground, slope[near] * last - ground
        meets = (first < last) & (first > 0) & (np.minimum(low, high) < STANDARD[2]) & (np.maximum(low, high) > 0.1)
        counted[index] = meets.sum()
    return counted


def _slab(start: float, direction: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
    """Where rays from ``start`` are between -half and +half: from, to."""
    safe = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    a, b = (-half - start) / safe, (half - start) / safe
    return np.minimum(a, b), np.maximum(a, b)


def _free(vehicles: FloatArray, half_extent_m: float, rng: np.random.Generator) -> FloatArray:
    """Places (n, 3) with a heading where no vehicle is."""
    in_lanes = round(LANE_SHARE * FREE_PLACES)
    count = 4 * FREE_PLACES
    anywhere = np.column_stack(
        [rng.uniform(-half_extent_m, half_extent_m, (count, 2)), rng.uniform(-np.pi, np.pi, count)]
    )
    kinds: list[tuple[FloatArray, int, float]] = [(anywhere, FREE_PLACES - in_lanes, CLEARANCE_M)]
    if len(vehicles):
        lane = np.column_stack([rng.uniform(-LANE_REACH_M, LANE_REACH_M, count), rng.normal(0.0, LANE_JITTER_M, count)])
        near = rng.uniform(-1.0, 1.0, (8 * NEAR_PLACES, 2)) * NEAR_REACH_M
        kinds.append((_beside(vehicles, lane, rng), in_lanes, CLEARANCE_M))
        kinds.append((_beside(vehicles, near, rng), NEAR_PLACES, NEAR_CLEARANCE_M))
    kept = []
    for options, wanted, clearance_m in kinds:
        cars = np.column_stack([options[:, :2], np.tile(STANDARD[:2], (len(options), 1)), options[:, 2]])
        grown = vehicles + np.array([0.0, 0.0, 2 * clearance_m, 2 * clearance_m, 0.0])
        apart = pairwise_iou(cars, grown).max(axis=1, initial=0.0) == 0.0
        inside = (np.abs(options[:, :2]) < half_extent_m - 1).all(axis=1) & (
            np.hypot(options[:, 0], options[:, 1]) > OWN_BODY_M
        )
        kept.append(options[apart & inside][:wanted])
    return np.concatenate(kept)


def _beside(vehicles: FloatArray, off: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Places (n, 3), each so far along and across (n, 2) from some vehicle, headed as it is."""
    chosen = vehicles[rng.integers(len(vehicles), size=len(off))]
    cos, sin = np.cos(chosen[:, 4]), np.sin(chosen[:, 4])
    x = chosen[:, 0] + off[:, 0] * cos - off[:, 1] * sin
    y = chosen[:, 1] + off[:, 0] * sin + off[:, 1] * cos
    return np.column_stack([x, y, chosen[:, 4]])
