"""Traffic at a synthetic intersection: where every vehicle and building is at a given time.

Two roads cross at the origin. On one axis the traffic flows; on the other it queues behind the stop lines; cars are
parked along both, and a building stands at each corner. All of it follows from one integer seed, and a position is a
closed formula of time, so that any frame can be had without the ones before it.

World frame: right-handed, metres, z up, ground at z = 0, origin at the centre of the crossing. The axes of the roads
are rotated by a random angle, so that nothing in the frame is aligned with the grid by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robosac.boxes import FloatArray

LANES_M = (1.75, 5.25)
PARKED_ROW_M = 8.4
ROAD_LENGTH_M = 150.0
STOP_LINE_M = 10.0
TRUCK_SHARE = 0.15
AGENT_RANGE_M = 30.0
MOVING_AGENT_RANGE_M = 12.0
MOVING_AGENTS = 2
MID_SCENE_S = 2.5
CAR_SENSOR_HEIGHT_M = 1.7
RSU_HEIGHT_M = 5.0

Speeds = tuple[float, float]
"""Lowest and highest, metres per second."""


@dataclass(frozen=True)
class Flow:
    """How much traffic there is at the intersection, and how fast it flows."""

    speed_mps: Speeds = (4.0, 9.0)
    """Of a lane of the flowing axis, drawn between these; all its vehicles have the same."""
    gap_m: float = 12.0
    more_gap_m: float = 7.0
    """From centre to centre in a flowing lane: at least the first, and more by the second on average."""
    queue: tuple[int, int] = (2, 5)
    """Fewest and most vehicles that wait in a lane."""
    tail_share: float = 0.5
    """Of the waiting lanes, those that hold the tail of the next junction's queue beyond the crossing."""
    parked_share: float = 0.3
    """Of the places at the kerb that are taken."""
    truck_share: float = TRUCK_SHARE
    """Of the vehicles on the lanes."""


PLAIN_FLOW = Flow()


@dataclass(frozen=True)
class Traffic:
    """Vehicles and buildings of one scene, and the agents among them."""

    along: FloatArray
    lateral: FloatArray
    """(V,): position at time 0 along the road and to the left of its direction, metres."""
    road_yaw: FloatArray
    """(V,): direction of the lane in the world, radians."""
    yaw_offset: FloatArray
    """(V,): deviation of the vehicle's heading from its lane, radians."""
    speed: FloatArray
    """(V,): metres per second; 0 in the queue and at the kerb."""
    size: FloatArray
    """(V, 3): length, width, height in metres."""
    buildings: FloatArray
    """(B, 6): x, y, length, width, yaw, height; world frame."""
    agent_vehicles: np.ndarray[tuple[int], np.dtype[np.int64]]
    """(A,) int: vehicles that carry a sensor."""
    rsu_pose: tuple[float, float, float]
    """(x, y, yaw): the roadside unit, world frame."""

    def vehicles_at(self, time_s: float) -> FloatArray:
        """Boxes of all vehicles.

        Returns
        -------
        (V, 5) ndarray
            x, y, length, width, yaw in the world frame.
        """
        half = ROAD_LENGTH_M / 2
        along = np.mod(self.along + self.speed * time_s + half, ROAD_LENGTH_M) - half
        cos, sin = np.cos(self.road_yaw), np.sin(self.road_yaw)
        x = cos * along - sin * self.lateral
        y = sin * along + cos * self.lateral
        return np.column_stack([x, y, self.size[:, :2], self.road_yaw + self.yaw_offset])


def draw_traffic(rng: np.random.Generator, car_agents: int, flow: Flow = PLAIN_FLOW) -> Traffic | None:
    """Draw the traffic of one scene.

    Parameters
    ----------
    rng : numpy.random.Generator
    car_agents : int
        Cars that carry a sensor, at least 1. At most two of them drive on the flowing axis, and those are within 12 m
        of the centre in the middle of a 5 s sequence; the others stand in the queue or at the kerb, within 30 m.
    flow : Flow

    Returns
    -------
    Traffic or None
        None if there are not enough such cars.
    """
    world_yaw = rng.uniform(-np.pi, np.pi)
    rows: list[tuple[float, float, float, float, bool]] = []  # along, lateral, road_yaw, speed, may be a truck
    for direction in (0.0, np.pi):
        for lane in LANES_M:
            rows += [(s, -lane, world_yaw + direction, v, True) for s, v in _flowing_lane(rng, flow)]
            rows += [(s, -lane, world_yaw + direction + np.pi / 2, 0.0, True) for s in _queue_lane(rng, flow)]
        for axis in (0.0, np.pi / 2):
            rows += [(s, -PARKED_ROW_M, world_yaw + direction + axis, 0.0, False) for s in _parked_row(rng, flow)]
    along, lateral, road_yaw, speed = (
        np.array(column, dtype=np.float64) for column in list(zip(*rows, strict=True))[:4]
    )
    may_be_truck = np.array([row[4] for row in rows])
    truck = may_be_truck & (rng.random(len(rows)) < flow.truck_share)
    size = draw_sizes(rng, truck)
    parked = np.abs(lateral) == PARKED_ROW_M
    traffic = Traffic(
        along=along,
        lateral=lateral + rng.normal(0.0, 0.12, len(rows)),
        road_yaw=road_yaw,
        yaw_offset=rng.normal(0.0, np.where(parked, 0.045, 0.025)),
        speed=speed,
        size=size,
        buildings=_buildings(rng, world_yaw),
        agent_vehicles=np.empty(0, dtype=np.int64),
        rsu_pose=_rsu(rng, world_yaw),
    )
    agents = choose_agents(rng, traffic, ~truck, car_agents)
    return None if agents is None else replace(traffic, agent_vehicles=agents)


def _flowing_lane(rng: np.random.Generator, flow: Flow) -> list[tuple[float, float]]:
    speed = rng.uniform(*flow.speed_mps)
    position = -ROAD_LENGTH_M / 2 + rng.uniform(0.0, 10.0)
    lane = []
    while position < ROAD_LENGTH_M / 2 - flow.gap_m:
        lane.append((position, speed))
        position += flow.gap_m + rng.exponential(flow.more_gap_m)
    return lane


def _queue_lane(rng: np.random.Generator, flow: Flow) -> list[float]:
    lane = []
    position = -STOP_LINE_M - rng.uniform(3.0, 5.5)
    for _ in range(rng.integers(flow.queue[0], flow.queue[1] + 1)):
        lane.append(position)
        position -= 10.0 + rng.exponential(0.7)
    if rng.random() < flow.tail_share:
        lane += [STOP_LINE_M + rng.uniform(12.0, 18.0), STOP_LINE_M + rng.uniform(28.5, 36.0)]
    return lane


def _parked_row(rng: np.random.Generator, flow: Flow) -> list[float]:
    slots = np.arange(17.0, 48.0, 6.6)
    slots = np.concatenate([-slots, slots])
    return [float(s) for s in slots[rng.random(len(slots)) < flow.parked_share] + rng.uniform(-0.4, 0.4)]


def draw_sizes(rng: np.random.Generator, truck: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> FloatArray:
    """Length, width and height (V, 3) of vehicles, metres; ``truck`` (V,) says which are lorries."""
    n = len(truck)
    car = np.column_stack([rng.uniform(3.9, 5.0, n), rng.uniform(1.7, 2.0, n), rng.uniform(1.4, 1.75, n)])
    lorry = np.column_stack([rng.uniform(6.5, 9.5, n), rng.uniform(2.3, 2.55, n), rng.uniform(2.7, 3.6, n)])
    return np.where(truck[:, None], lorry, car)


def _buildings(rng: np.random.Generator, world_yaw: float) -> FloatArray:
    cos, sin = np.cos(world_yaw), np.sin(world_yaw)
    boxes = []
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            near = rng.uniform(10.5, 13.0, 2)
            extent = rng.uniform(25.0, 50.0, 2)
            cx, cy = sx * (near[0] + extent[0] / 2), sy * (near[1] + extent[1] / 2)
            boxes.append([cos * cx - sin * cy, sin * cx + cos * cy, *extent, world_yaw, rng.uniform(6.0, 15.0)])
    return np.array(boxes)


def _rsu(rng: np.random.Generator, world_yaw: float) -> tuple[float, float, float]:
    corner = rng.integers(4)
    angle = world_yaw + np.pi / 4 + corner * np.pi / 2
    radius = rng.uniform(12.8, 14.0)  # between the kerb and the nearest corner a building may have
    return float(radius * np.cos(angle)), float(radius * np.sin(angle)), float(rng.uniform(-np.pi, np.pi))


def choose_agents(
    rng: np.random.Generator,
    traffic: Traffic,
    is_car: np.ndarray[tuple[int], np.dtype[np.bool_]],
    count: int,
    moving_range_m: float = MOVING_AGENT_RANGE_M,
    standing_range_m: float = AGENT_RANGE_M,
    most_moving: int = MOVING_AGENTS,
) -> np.ndarray[tuple[int], np.dtype[np.int64]] | None:
    """Draw the cars that carry a sensor.

    Parameters
    ----------
    rng : numpy.random.Generator
    traffic : Traffic
    is_car : (V,) bool ndarray
        Which vehicles may be one.
    count : int
        How many.
    moving_range_m, standing_range_m : float
        Those that move, and those that stand, are as near the origin in the middle of a 5 s sequence.
    most_moving : int
        So many move at most; the others stand.

    Returns
    -------
    (count,) int ndarray or None
        None if there are not enough.
    """
    mid = traffic.vehicles_at(MID_SCENE_S)
    distance = np.hypot(mid[:, 0], mid[:, 1])
    drives = traffic.speed > 0
    moving = np.flatnonzero(is_car & drives & (distance < moving_range_m))
    moving = rng.permutation(moving)[: min(most_moving, count - 1)]
    standing = np.flatnonzero(is_car & ~drives & (distance < standing_range_m))
    standing = rng.permutation(standing)[: count - len(moving)]
    chosen = np.concatenate([moving, standing])
    return rng.permutation(chosen) if len(chosen) == count else None
