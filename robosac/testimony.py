"""What each agent's own message says of places: testimony that no other agent can forge.

A witness network reads one agent's message alone and says for every place how much better it fits a vehicle than none
(`robosac.detectors.witness`). Here is what came of it in one frame, in numpy, for whoever judges boxes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robosac.boxes import FloatArray

LIKELIHOOD, X, Y, ALONG, ACROSS = range(5)
"""Layers of a map: L, the vehicle's centre seen from the place's centre (x and y, metres), and logarithms of how far it
may be off along and across the vehicle (metres).
"""
LAYERS = 5
MOST = 6.0
"""L is clipped to +- this: beyond it the network has seen too little to know."""


@dataclass(frozen=True)
class Sighting:
    """Where each of some agents sees the vehicle that is nearest to each of n places; ego frame."""

    centre: FloatArray
    """(agents, n, 2): metres."""
    along: FloatArray
    across: FloatArray
    """(agents, n): how far it may be off, along and across the vehicle: mean absolute error, metres."""


@dataclass(frozen=True)
class Testimony:
    """What all messages of a frame say, each by itself."""

    __test__ = False  # no test of pytest's, whatever its name

    agents: tuple[str, ...]
    """Who sent them; the ego is ``robosac.defenses.EGO``."""
    maps: FloatArray
    """(agents, LAYERS, H, W): each in its sender's frame, rows along +y, columns along +x. `LIKELIHOOD` is L = ln p(map
    | a vehicle is centred here) / p(map | none is here), 0 where nothing was observed.
    """
    from_ego: FloatArray
    """(agents, 3, 3): the plane of the ego's frame in each sender's."""
    over_ego: FloatArray
    """(agents, H, W): `LIKELIHOOD` laid over the ego's map, 0 outside the sender's."""
    half_extent_m: float
    """Maps cover +- this in both directions."""

    def ego_places(self) -> FloatArray:
        """Centres (H, W, 2) of the places of the ego's map, ego frame, metres."""
        height, width = self.over_ego.shape[-2:]
        x = (np.arange(width) + 0.5) * (2 * self.half_extent_m / width) - self.half_extent_m
        y = (np.arange(height) + 0.5) * (2 * self.half_extent_m / height) - self.half_extent_m
        return np.stack(np.meshgrid(x, y), axis=-1)

    def places(self, points: FloatArray) -> FloatArray:
        """Places (n, 2), ego frame, in each sender's frame: (agents, n, 2), metres."""
        turned: FloatArray = np.einsum("aij,nj->ani", self.from_ego[:, :2, :2], points) + self.from_ego[:, None, :2, 2]
        return turned

    def likelihood(self, points: FloatArray) -> FloatArray:
        """L at places (n, 2), ego frame: (agents, n), bilinear, within +- `MOST`, 0 outside a map."""
        height, width = self.maps.shape[-2:]
        local = self.places(points)
        column = (local[..., 0] + self.half_extent_m) * width / (2 * self.half_extent_m) - 0.5
        row = (local[..., 1] + self.half_extent_m) * height / (2 * self.half_extent_m) - 0.5
        padded = self._padded
        r = np.clip(np.floor(row).astype(np.int64) + 1, 0, height)
        c = np.clip(np.floor(column).astype(np.int64) + 1, 0, width)
        y, x = np.clip(row + 1 - r, 0.0, 1.0), np.clip(column + 1 - c, 0.0, 1.0)
        who = np.arange(len(self.agents))[:, None]
        top = padded[who, r, c] * (1 - x) + padded[who, r, c + 1] * x
        bottom = padded[who, r + 1, c] * (1 - x) + padded[who, r + 1, c + 1] * x
        value: FloatArray = top * (1 - y) + bottom * y
        return value

    @cached_property
    def _padded(self) -> FloatArray:
        """L within its bounds, zeros around each map: (agents, H + 3, W + 3)."""
        padded: FloatArray = np.pad(np.clip(self.maps[:, LIKELIHOOD], -MOST, MOST), [(0, 0), (1, 2), (1, 2)])
        return padded

    @cached_property
    def _to_ego(self) -> FloatArray:
        return np.linalg.inv(self.from_ego)

    def sighting(self, points: FloatArray) -> Sighting:
        """Where each agent sees the vehicles at places (n, 2), ego frame. It means something where L is high."""
        height, width = self.maps.shape[-2:]
        cell_x, cell_y = 2 * self.half_extent_m / width, 2 * self.half_extent_m / height
        local = self.places(points)
        column = np.clip(((local[..., 0] + self.half_extent_m) / cell_x).astype(np.int64), 0, width - 1)
        row = np.clip(((local[..., 1] + self.half_extent_m) / cell_y).astype(np.int64), 0, height - 1)
        found = self.maps[np.arange(len(self.agents))[:, None], :, row, column]  # (agents, n, LAYERS)
        x = (column + 0.5) * cell_x - self.half_extent_m + found[..., X]
        y = (row + 0.5) * cell_y - self.half_extent_m + found[..., Y]
        back = self._to_ego
        centre = np.einsum("aij,anj->ani", back[:, :2, :2], np.stack([x, y], axis=-1)) + back[:, None, :2, 2]
        return Sighting(centre, np.exp(found[..., ALONG]), np.exp(found[..., ACROSS]))

    def of(self, agents: Collection[str]) -> Testimony:
        """That of some of them alone."""
        kept = [i for i, name in enumerate(self.agents) if name in agents]
        return Testimony(
            tuple(self.agents[i] for i in kept),
            self.maps[kept],
            self.from_ego[kept],
            self.over_ego[kept],
            self.half_extent_m,
        )


def planar(ego_pose: FloatArray, poses: Sequence[FloatArray]) -> FloatArray:
    """The ego's plane in each sender's frame (n, 3, 3), of their poses world_from_sensor (4, 4)."""
    relative = np.linalg.inv(np.stack(poses)) @ ego_pose
    found = np.tile(np.eye(3), (len(poses), 1, 1))
    found[:, :2, :2], found[:, :2, 2] = relative[:, :2, :2], relative[:, :2, 3]
    return found
