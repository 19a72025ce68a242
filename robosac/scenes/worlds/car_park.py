"""A car park: rows of parked cars along three aisles, a few cars that drive slowly.

World frame: right-handed, metres, z up, ground at z = 0, origin in the middle. The aisles run in a random direction;
each goes on as a road beyond the rows, to 75 m from the middle, where who leaves comes in on the other side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robosac.boxes import FloatArray
from robosac.scenes.intersection import GeneratedScene
from robosac.scenes.world import ROAD_LENGTH_M, Speeds, Traffic, choose_agents, draw_sizes
from robosac.scenes.worlds.density import Density

AISLES_M = (-18.0, 0.0, 18.0)
ROW_M = 5.9
"""From the middle of an aisle to the middle of the rows on its sides."""
LANE_M = 1.6
PITCH_M = 3.1
HALF_ROW_M = 42.0
SPEED_MPS = (1.5, 4.0)
MOVING_RANGE_M = 20.0
STANDING_RANGE_M = 24.0
TAKEN: Mapping[Density, float] = {"sparse": 0.15, "plain": 0.3, "dense": 0.45, "jammed": 0.45}
"""Share of the places that are taken."""
GAPS_M: Mapping[Density, tuple[float, float]] = {
    "sparse": (50.0, 60.0),
    "plain": (25.0, 30.0),
    "dense": (12.0, 15.0),
    "jammed": (7.0, 1.0),
}
"""From centre to centre of those who drive one way in an aisle: at least, and more on average."""


@dataclass(frozen=True)
class CarPark(GeneratedScene):
    """Six rows of parked cars, and cars that drive at 1.5 to 4 m/s; jammed, at 0 to 1 m/s."""

    density: Density = "plain"
    speed_mps: Speeds | None = None
    """By default that of the density."""

    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """Cars, if there are enough for all sensors near the middle."""
        traffic = self._drawn(rng)
        anybody = np.ones(len(traffic.size), dtype=bool)
        chosen = choose_agents(rng, traffic, anybody, self.car_agents, MOVING_RANGE_M, STANDING_RANGE_M)
        return None if chosen is None else replace(traffic, agent_vehicles=chosen)

    def _drawn(self, rng: np.random.Generator) -> Traffic:
        world_yaw = rng.uniform(-np.pi, np.pi)
        rows: list[tuple[float, float, float, float, float]] = []  # along, lateral, road yaw, speed, turn from it
        for aisle in AISLES_M:
            for side in (-1.0, 1.0):
                rows += [(along, aisle + side * ROW_M, 0.0, 0.0, turn) for along, turn in self._row(rng)]
                yaw = 0.0 if side < 0 else np.pi  # they drive on the right
                lateral = -aisle - LANE_M if side > 0 else aisle - LANE_M
                rows += [(along, lateral, yaw, speed, 0.0) for along, speed in self._driving(rng)]
        along, lateral, road_yaw, speed, turn = np.array(rows).T
        return Traffic(
            along=along,
            lateral=lateral + rng.normal(0.0, 0.1, len(rows)),
            road_yaw=world_yaw + road_yaw,
            yaw_offset=turn + rng.normal(0.0, 0.02, len(rows)),
            speed=speed,
            size=draw_sizes(rng, np.zeros(len(rows), dtype=bool)),
            buildings=_buildings(rng, world_yaw),
            agent_vehicles=np.empty(0, dtype=np.int64),
            rsu_pose=_lamp(rng, world_yaw),
        )

    def _row(self, rng: np.random.Generator) -> list[tuple[float, float]]:
        """Where cars are parked in a row, and which way they point."""
        places = np.arange(-HALF_ROW_M, HALF_ROW_M, PITCH_M)
        taken = places[rng.random(len(places)) < TAKEN[self.density]]
        taken = taken + rng.uniform(-0.2, 0.2, len(taken))
        turns = np.where(rng.random(len(taken)) < 0.5, np.pi / 2, -np.pi / 2)
        return list(zip(taken.tolist(), turns.tolist(), strict=True))

    def _driving(self, rng: np.random.Generator) -> list[tuple[float, float]]:
        gap, more = GAPS_M[self.density]
        speed = float(rng.uniform(*(self.speed_mps or ((0.0, 1.0) if self.density == "jammed" else SPEED_MPS))))
        position = -ROAD_LENGTH_M / 2 + rng.uniform(0.0, gap + more)
        end = ROAD_LENGTH_M / 2 - gap
        lane = []
        while position < end:
            lane.append((position, speed))
            position += gap + rng.exponential(more)
        return lane


def _buildings(rng: np.random.Generator, world_yaw: float) -> FloatArray:
    """A shop on one side, and lamp posts between the rows that stand back to back."""
    cos, sin = np.cos(world_yaw), np.sin(world_yaw)
    shop = AISLES_M[-1] + ROW_M + rng.uniform(8.0, 14.0)
    depth = rng.uniform(15.0, 25.0)
    boxes = [(rng.uniform(-15.0, 15.0), rng.choice([-1.0, 1.0]) * (shop + depth / 2), 60.0, depth, 7.0)]
    between = (AISLES_M[1] + AISLES_M[2]) / 2
    boxes += [(x, y, 0.3, 0.3, 6.0) for x in (-24.0, 24.0) for y in (-between, between)]
    return np.array([[cos * x - sin * y, sin * x + cos * y, a, b, world_yaw, height] for x, y, a, b, height in boxes])


def _lamp(rng: np.random.Generator, world_yaw: float) -> tuple[float, float, float]:
    """The roadside unit, on a post between two rows."""
    x, y = rng.uniform(-8.0, 8.0), rng.choice([-1.0, 1.0]) * (AISLES_M[1] + AISLES_M[2]) / 2
    cos, sin = np.cos(world_yaw), np.sin(world_yaw)
    return float(cos * x - sin * y), float(sin * x + cos * y), float(rng.uniform(-np.pi, np.pi))
