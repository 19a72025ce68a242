"""A straight highway with three lanes a direction.

World frame: right-handed, metres, z up, ground at z = 0. The road runs through the origin in a random direction; a
roadside unit stands beside it there. A low barrier parts the directions, and a wall stands on either side. The agents
drive in one direction and pass the roadside unit 2.5 s after frame 0.

The road has no end. Traffic is kept in a window of 280 m that travels with the agents: who falls out of it behind comes
back ahead, 140 m away, out of every agent's sight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robosac.boxes import FloatArray
from robosac.scenes.intersection import GeneratedScene
from robosac.scenes.world import MID_SCENE_S, Speeds, Traffic, draw_sizes
from robosac.scenes.worlds.density import Density

LANES_M = (2.6, 6.3, 10.0)
"""Centres of the lanes, metres to the right of the middle of the road; the last one is the slowest."""
WINDOW_M = 280.0
WALL_M = 15.0
WALL_LENGTH_M = 40_000.0
RSU_OFFSET_M = 13.0
AGENT_RANGE_M = 45.0
TRUCK_SHARE = 0.3
"""Of the vehicles on the slowest lane; on the others it is a sixth of that."""
FREE_MPS = (22.0, 30.0)
JAMMED_MPS = (0.0, 5.0)
GAPS_M: Mapping[Density, tuple[float, float]] = {
    "sparse": (40.0, 20.0),
    "plain": (25.0, 12.0),
    "dense": (14.0, 5.0),
    "jammed": (10.5, 1.0),
}
"""From centre to centre in a lane: at least the first, and more by the second on average."""


@dataclass(frozen=True)
class HighwayTraffic(Traffic):
    """Traffic in a window that travels along the road."""

    ahead: FloatArray
    """(V,): 1 for those who drive as the agents do, -1 for the others."""
    window_mps: float
    """How fast the window travels."""

    def vehicles_at(self, time_s: float) -> FloatArray:
        """Boxes (V, 5) of all vehicles, world frame; ``along`` and ``lateral`` hold 2.5 s after frame 0."""
        since = time_s - MID_SCENE_S
        centre = self.ahead * self.window_mps * since
        half = WINDOW_M / 2
        along = np.mod(self.along + self.speed * since - centre + half, WINDOW_M) - half + centre
        cos, sin = np.cos(self.road_yaw), np.sin(self.road_yaw)
        x = cos * along - sin * self.lateral
        y = sin * along + cos * self.lateral
        return np.column_stack([x, y, self.size[:, :2], self.road_yaw + self.yaw_offset])


@dataclass(frozen=True)
class Highway(GeneratedScene):
    """Three lanes a direction at 22 to 30 m/s, the inner ones the faster; jammed, each lane at 0 to 5 m/s."""

    density: Density = "plain"
    speed_mps: Speeds | None = None
    """By default that of the density."""

    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """Lanes, if there are enough cars near each other that drive in one direction."""
        traffic = self._drawn(rng)
        mid = np.hypot(*traffic.vehicles_at(MID_SCENE_S)[:, :2].T)
        cars = traffic.size[:, 2] < 2.0  # lorries are higher
        near = np.flatnonzero(cars & (traffic.ahead > 0) & (mid < AGENT_RANGE_M))
        if len(near) < self.car_agents:
            return None
        chosen = near[np.argsort(mid[near])][: self.car_agents]
        return replace(traffic, agent_vehicles=rng.permutation(chosen))

    def _drawn(self, rng: np.random.Generator) -> HighwayTraffic:
        world_yaw = rng.uniform(-np.pi, np.pi)
        rows: list[tuple[float, float, float, float, float]] = []  # along, lateral, ahead, speed, share of lorries
        window = 0.0
        for ahead in (1.0, -1.0):
            for number, (offset, speed) in enumerate(zip(LANES_M, self._speeds(rng), strict=True)):
                trucks = TRUCK_SHARE if number == len(LANES_M) - 1 else TRUCK_SHARE / 6
                rows += [(along, -offset, ahead, speed, trucks) for along in self._lane(rng)]
                if ahead > 0 and number == 1:
                    window = speed
        along, lateral, ahead_of, speeds, trucks_of = np.array(rows).T
        return HighwayTraffic(
            along=along,
            lateral=lateral + rng.normal(0.0, 0.12, len(rows)),
            road_yaw=np.where(ahead_of > 0, world_yaw, world_yaw + np.pi),
            yaw_offset=rng.normal(0.0, 0.01, len(rows)),
            speed=speeds,
            size=draw_sizes(rng, rng.random(len(rows)) < trucks_of),
            buildings=_walls(rng, world_yaw),
            agent_vehicles=np.empty(0, dtype=np.int64),
            rsu_pose=_roadside(rng, world_yaw),
            ahead=ahead_of,
            window_mps=window,
        )

    def _speeds(self, rng: np.random.Generator) -> FloatArray:
        """Of the lanes of one direction, the inner ones the faster unless the traffic is jammed."""
        low, high = self.speed_mps or (JAMMED_MPS if self.density == "jammed" else FREE_MPS)
        if self.density == "jammed":
            return rng.uniform(low, high, len(LANES_M))
        third = (high - low) / len(LANES_M)
        return low + third * (np.arange(len(LANES_M))[::-1] + rng.random(len(LANES_M)))

    def _lane(self, rng: np.random.Generator) -> list[float]:
        gap, more = GAPS_M[self.density]
        position = -WINDOW_M / 2 + rng.uniform(0.0, gap)
        end = position + WINDOW_M - gap
        lane = []
        while position <= end:
            lane.append(position)
            position += gap + rng.exponential(more)
        return lane


def _walls(rng: np.random.Generator, world_yaw: float) -> FloatArray:
    """The barrier in the middle, and a wall on either side."""
    left, right = WALL_M + rng.uniform(0.0, 4.0, 2)
    normal = np.array([-np.sin(world_yaw), np.cos(world_yaw)])
    return np.array(
        [
            [*(offset * normal), WALL_LENGTH_M, width, world_yaw, height]
            for offset, width, height in ((0.0, 0.4, 0.8), (left, 0.5, 4.0), (-right, 0.5, 4.0))
        ]
    )


def _roadside(rng: np.random.Generator, world_yaw: float) -> tuple[float, float, float]:
    side = rng.choice([-1.0, 1.0]) * RSU_OFFSET_M
    x, y = -np.sin(world_yaw) * side, np.cos(world_yaw) * side
    return float(x), float(y), float(rng.uniform(-np.pi, np.pi))
