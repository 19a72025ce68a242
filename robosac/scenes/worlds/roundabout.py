"""A roundabout with four arms, one lane each way.

World frame: right-handed, metres, z up, ground at z = 0, origin in the middle. Traffic drives on the right, so it goes
round counter-clockwise. All that drive have one speed, and the circle has moving slots for them, at least 13 m apart.
A vehicle comes in on an arm just when its slot passes, stays in it for one to three quarters of the circle, and leaves
on another arm. Before and after it the slot is free for others. So nobody ever gives way, nothing overlaps, and every
position is a closed formula of time.

A way is as long as twice the circle; who reaches its end, 50 m or more from the middle, starts again at its beginning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robosac.boxes import FloatArray, IntArray
from robosac.scenes.intersection import GeneratedScene
from robosac.scenes.world import Speeds, Traffic, choose_agents, draw_sizes
from robosac.scenes.worlds.density import Density

RADIUS_M = (15.0, 22.0)
LANE_M = 2.3
FILLET_M = 8.0
"""Radius of the bend from an arm into the circle, and out of it."""
SLOT_M = 13.0
PARKED_ROW_M = 5.6
PARKED_FROM_M, PARKED_TO_M, PARKED_PITCH_M = 10.5, 45.0, 6.6
"""From the circle along an arm."""
TRUCK_SHARE = 0.12
SPEED_MPS = (5.0, 9.0)
JAMMED_MPS = (0.0, 2.0)
LAPS = 2
"""A way is as long as so many circles."""
MOVING_RANGE_M = 6.0
"""Beyond the circle."""
MOVING_AGENTS = 4
TAKEN: Mapping[Density, tuple[float, float]] = {
    "sparse": (0.25, 0.15),
    "plain": (0.7, 0.5),
    "dense": (1.0, 0.8),
    "jammed": (1.0, 0.8),
}
"""Share of the slots, and of the places at the kerb of the arms, that are taken."""


@dataclass(frozen=True)
class RoundaboutTraffic(Traffic):
    """The first vehicles drive on ways through the circle; the others are parked."""

    radius: float
    world_yaw: float
    angle: FloatArray
    """(W,): of the slot of each vehicle that drives, at time 0, radians from the first arm."""
    arm: IntArray
    quarters: IntArray
    """(W,): on which arm it comes in, and after how many quarters of the circle it leaves."""
    lap: IntArray
    """(W,): which of the two that share slot and way it is."""

    def vehicles_at(self, time_s: float) -> FloatArray:
        """Boxes (V, 5) of all vehicles, world frame."""
        boxes = super().vehicles_at(time_s)
        driving = len(self.angle)
        x, y, yaw = self._on_way(time_s)
        cos, sin = np.cos(self.world_yaw), np.sin(self.world_yaw)
        boxes[:driving, 0], boxes[:driving, 1] = cos * x - sin * y, sin * x + cos * y
        boxes[:driving, 4] = yaw + self.world_yaw + self.yaw_offset[:driving]
        return boxes

    def _on_way(self, time_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, y and heading (W,) of those who drive, the first arm along +x."""
        r, circle = self.radius, 2 * np.pi * self.radius
        centre_x, entry = _fillet(r)
        bend = FILLET_M * (np.pi / 2 - entry)
        arc = r * (self.quarters * np.pi / 2 - 2 * entry)
        straight = (LAPS * circle - arc) / 2 - bend
        first = straight + bend
        passed = r * (self.angle - self.arm * np.pi / 2 - entry) + self.speed[: len(self.angle)] * time_s
        at = np.mod(passed + self.lap * circle + first, LAPS * circle) - first  # metres since it came into the circle

        # on an arm both ways look alike: what leaves is what comes in, seen in a mirror and backwards
        leaves = at > arc / 2
        before = np.where(leaves, at - arc, -at)
        turned = np.clip(before / FILLET_M, 0.0, np.pi / 2 - entry)
        from_centre = entry + np.pi + turned  # on the bend, as seen from its centre
        arm_x = centre_x + FILLET_M * np.cos(from_centre) + np.maximum(before - bend, 0.0)
        arm_y = LANE_M + FILLET_M + FILLET_M * np.sin(from_centre)
        heading = np.where(leaves, np.pi / 2 - entry - turned, np.pi / 2 + entry + turned)
        arm_y = np.where(leaves, -arm_y, arm_y)

        on_circle = (at >= 0) & (at <= arc)
        along = entry + at / r
        x = np.where(on_circle, r * np.cos(along), arm_x)
        y = np.where(on_circle, r * np.sin(along), arm_y)
        yaw = np.where(on_circle, along + np.pi / 2, heading)
        turn = (self.arm + np.where(leaves & ~on_circle, self.quarters, 0)) * np.pi / 2
        cos, sin = np.cos(turn), np.sin(turn)
        return cos * x - sin * y, sin * x + cos * y, yaw + turn


@dataclass(frozen=True)
class Roundabout(GeneratedScene):
    """A circle of radius 15 to 22 m on which all drive at 5 to 9 m/s; jammed, at 0 to 2 m/s."""

    density: Density = "plain"
    speed_mps: Speeds | None = None
    """By default that of the density."""

    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """Vehicles, if there are enough cars near the circle."""
        traffic = self._drawn(rng)
        cars = traffic.size[:, 2] < 2.0  # lorries are higher
        near, parked = traffic.radius + MOVING_RANGE_M, traffic.radius + PARKED_FROM_M + 1.5 * PARKED_PITCH_M
        chosen = choose_agents(rng, traffic, cars, self.car_agents, near, parked, MOVING_AGENTS)
        return None if chosen is None else replace(traffic, agent_vehicles=chosen)

    def _drawn(self, rng: np.random.Generator) -> RoundaboutTraffic:
        world_yaw, radius = rng.uniform(-np.pi, np.pi), rng.uniform(*RADIUS_M)
        slots, kerbs = TAKEN[self.density]
        ways = _ways(rng, radius, slots)
        parked = _parked(rng, radius, kerbs)
        driving, total = len(ways), len(ways) + len(parked)
        angle, arm, quarters, lap = (column.reshape(-1) for column in np.hsplit(np.array(ways).reshape(-1, 4), 4))
        along, lateral, road_yaw = (column.reshape(-1) for column in np.hsplit(np.array(parked).reshape(-1, 3), 3))
        speed = rng.uniform(*(self.speed_mps or (JAMMED_MPS if self.density == "jammed" else SPEED_MPS)))
        on_way = np.arange(total) < driving
        nowhere = np.zeros(driving)
        return RoundaboutTraffic(
            along=np.concatenate([nowhere, along]),
            lateral=np.concatenate([nowhere, lateral]),
            road_yaw=np.concatenate([nowhere, road_yaw + world_yaw]),
            yaw_offset=rng.normal(0.0, np.where(on_way, 0.02, 0.045)),
            speed=np.where(on_way, speed, 0.0),
            size=draw_sizes(rng, on_way & (rng.random(total) < TRUCK_SHARE)),
            buildings=_buildings(rng, radius, world_yaw),
            agent_vehicles=np.empty(0, dtype=np.int64),
            rsu_pose=_corner(rng, radius, world_yaw),
            radius=radius,
            world_yaw=world_yaw,
            angle=angle,
            arm=arm.astype(np.int64),
            quarters=quarters.astype(np.int64),
            lap=lap.astype(np.int64),
        )


def _fillet(radius: float) -> tuple[float, float]:
    """The bend between the lane of an arm along +x and the circle: x of its centre, and the angle at which it ends.

    Its centre is at y = LANE_M + FILLET_M, and FILLET_M beyond the circle.
    """
    y = LANE_M + FILLET_M
    x = float(np.sqrt((radius + FILLET_M) ** 2 - y**2))
    return x, float(np.arctan2(y, x))


def _ways(rng: np.random.Generator, radius: float, share: float) -> list[tuple[float, int, int, int]]:
    """Angle, arm, quarters and lap of all that drive."""
    slots = int(2 * np.pi * radius / SLOT_M)
    start = rng.uniform(0.0, 2 * np.pi)
    ways = []
    for slot in range(slots):
        arm, used = int(rng.integers(4)), 0
        while used < 4:
            if rng.random() < share:
                quarters = int(rng.integers(1, min(3, 4 - used) + 1))
                for lap in range(LAPS):
                    ways.append((start + 2 * np.pi * slot / slots, arm, quarters, lap))
            else:
                quarters = 1
            arm, used = (arm + quarters) % 4, used + quarters
    return ways


def _parked(rng: np.random.Generator, radius: float, share: float) -> list[tuple[float, float, float]]:
    """Along, lateral and direction of all at the kerbs, each beside the lane that goes its way."""
    places = radius + np.arange(PARKED_FROM_M, PARKED_TO_M, PARKED_PITCH_M)
    rows = []
    for arm in range(4):
        for outwards in (True, False):
            yaw = arm * np.pi / 2 + (0.0 if outwards else np.pi)
            taken = places[rng.random(len(places)) < share]
            taken = taken + rng.uniform(-0.4, 0.4, len(taken))
            rows += [(float(s if outwards else -s), -PARKED_ROW_M, yaw) for s in taken]
    return rows


def _buildings(rng: np.random.Generator, radius: float, world_yaw: float) -> FloatArray:
    """The island in the middle, and a building at each corner."""
    cos, sin = np.cos(world_yaw), np.sin(world_yaw)
    boxes = [[0.0, 0.0, radius, radius, world_yaw + rng.uniform(-np.pi, np.pi), rng.uniform(0.8, 2.5)]]
    clear = max(11.0, (radius + 8.0) / np.sqrt(2.0))
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            near, extent = clear + rng.uniform(0.0, 5.0, 2), rng.uniform(20.0, 40.0, 2)
            cx, cy = sx * (near[0] + extent[0] / 2), sy * (near[1] + extent[1] / 2)
            boxes.append([cos * cx - sin * cy, sin * cx + cos * cy, *extent, world_yaw, rng.uniform(5.0, 12.0)])
    return np.array(boxes)


def _corner(rng: np.random.Generator, radius: float, world_yaw: float) -> tuple[float, float, float]:
    """The roadside unit, between the circle and a building."""
    angle = world_yaw + np.pi / 4 + rng.integers(4) * np.pi / 2
    away = radius + rng.uniform(4.0, 6.0)
    return float(away * np.cos(angle)), float(away * np.sin(angle)), float(rng.uniform(-np.pi, np.pi))
