"""Where an object could stand that does not exist, and where vehicles are that are followed from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robosac.boxes import BoolArray, FloatArray

CLEARANCE_M = 5.0
"""From a made-up object to every vehicle, agent and other made-up object."""
UNSEEN_M = 3.0
"""From a made-up object to all that the detector shows already."""
REACH_M = 25.0
"""From a made-up object to the ego, at most."""
HEARD_M = 28.0
"""From an object to an attacker along either axis, at most: a map that ends before says nothing there."""
GAP_M = (8.0, 14.0)
"""Along its heading, from a vehicle to an object in the gap before or behind it."""
AHEAD_M = (7.0, 15.0)
"""From the ego to an object in its path."""
STEP_M = 0.5
CAR_M = (4.5, 1.9)
"""Length and width of a made-up car."""
ACROSS_M = 1.0
ALONG_M_S = 35.0
"""A vehicle moves no more than this across its heading from frame to frame, and no faster along it."""


@dataclass(frozen=True)
class Room:
    """What leaves no room for a made-up object; ego frame."""

    vehicles: FloatArray
    """(V, 5): true boxes."""
    agents: FloatArray
    """(A, 2): those who sense, the ego among them."""
    shown: FloatArray
    """(K, 2): centres of what the ego alone or the honest fusion shows."""
    liars: FloatArray
    """(L, 2): the attackers, one of whom has to be near."""

    def free(self, places: FloatArray, others: Sequence[FloatArray] = ()) -> FloatArray:
        """Those of some places (n, 5) that are free, (m, 5), given other made-up objects (5,)."""
        taken = np.vstack([self.vehicles[:, :2], self.agents, *(other[None, :2] for other in others)])
        clear = _nearest(places, taken) >= CLEARANCE_M
        clear &= _nearest(places, self.shown) >= UNSEEN_M
        clear &= heard(places, self.liars)
        kept: FloatArray = places[clear & (np.hypot(places[:, 0], places[:, 1]) <= REACH_M)]
        return kept


def heard(places: FloatArray, liars: FloatArray) -> BoolArray:
    """Whether each of some places (n, 2+) is within reach of the map of one of the attackers (L, 2)."""
    far = np.abs(places[:, None, :2] - liars[None]).max(axis=2)
    near: BoolArray = far.min(axis=1, initial=np.inf) <= HEARD_M
    return near


def _nearest(places: FloatArray, points: FloatArray) -> FloatArray:
    """Distance (n,) from places (n, 2+) to the nearest of some points (m, 2)."""
    if not len(points):
        return np.full(len(places), np.inf)
    apart: FloatArray = np.hypot(*(places[:, None, :2] - points[None]).transpose(2, 0, 1)).min(axis=1)
    return apart


def lane_places(vehicles: FloatArray) -> FloatArray:
    """Places on the line of each vehicle's heading, ahead of and behind it.

    Parameters
    ----------
    vehicles : (V, 5) ndarray

    Returns
    -------
    (n, 6) ndarray
        Boxes of cars, headed as the vehicle, and the vehicle's number.
    """
    ahead = np.arange(GAP_M[0], GAP_M[1] + STEP_M / 2, STEP_M)
    offsets = np.concatenate([ahead, -ahead])
    number = np.repeat(np.arange(len(vehicles)), len(offsets))
    along, yaw = np.tile(offsets, len(vehicles)), vehicles[number, 4]
    x = vehicles[number, 0] + along * np.cos(yaw)
    y = vehicles[number, 1] + along * np.sin(yaw)
    return np.column_stack([x, y, np.tile(CAR_M, (len(number), 1)), yaw, number])


def path_places() -> FloatArray:
    """Places (n, 5) in the ego's path, headed as it is; ego frame."""
    x = np.arange(AHEAD_M[0], AHEAD_M[1] + STEP_M / 2, STEP_M)
    return np.column_stack([x, np.zeros_like(x), np.tile(CAR_M, (len(x), 1)), np.zeros_like(x)])


def any_places(rng: np.random.Generator, count: int = 400) -> FloatArray:
    """Random places (n, 5) within reach of the ego, headed anywhere."""
    radius, angle = REACH_M * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    yaw = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.tile(CAR_M, (count, 1)), yaw],
    )


def advanced(box: FloatArray, metres: float) -> FloatArray:
    """A box (5+,) that has driven so far along its heading."""
    moved = np.array(box, dtype=np.float64)
    moved[:2] += metres * np.array([np.cos(box[4]), np.sin(box[4])])
    return moved


@dataclass(frozen=True)
class Followed:
    """A true vehicle that is followed in the world."""

    box: FloatArray
    """(5,): where it was seen last."""
    speed: float | None = None
    """Along its heading, m/s; None before it was seen twice."""

    def among(self, vehicles: FloatArray, elapsed_s: float) -> Followed | None:
        """The same vehicle among boxes (V, 5) some time later, world frame; None if it is not there.

        Of those where it can have driven it is the one nearest to where it should be at its last speed.
        """
        if not len(vehicles):
            return None
        yaw = self.box[4]
        dx, dy = vehicles[:, 0] - self.box[0], vehicles[:, 1] - self.box[1]
        along, across = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
        expected = (self.speed or 0.0) * elapsed_s
        far = np.abs(along - expected)
        far[(np.abs(across) > ACROSS_M) | (np.abs(along) > ALONG_M_S * elapsed_s)] = np.inf
        best = int(far.argmin())
        return None if np.isinf(far[best]) else Followed(vehicles[best], float(along[best]) / elapsed_s)
