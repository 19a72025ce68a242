"""The synthetic intersection: sequences of sensor views with true boxes, deterministic by seed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral

import numpy as np

from robosac.boxes import FloatArray, IntArray, from_world, pose_matrix
from robosac.scenes.base import Split, View
from robosac.scenes.lidar import Lidar
from robosac.scenes.splits import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from robosac.scenes.world import CAR_SENSOR_HEIGHT_M, RSU_HEIGHT_M, Traffic, draw_traffic

FRAME_PERIOD_S = 0.2
DRAWS = 1000
"""Times that traffic is drawn, at most, until enough cars are near each other to carry the sensors."""
TRUTH_MIN_HITS = 6
TRUTH_RANGE_M = 31.0


@dataclass(frozen=True)
class AgentView(View):
    """What one agent senses in one frame; the z of its pose is the sensor's height above ground."""

    hits: IntArray
    """(V,) int: returns from each vehicle of the scene."""


@dataclass(frozen=True)
class SceneFrame:
    """One instant of a scene."""

    index: int
    vehicles: FloatArray
    """(V, 5): x, y, length, width, yaw of every vehicle; world frame."""
    views: Mapping[str, AgentView]
    carriers: Mapping[str, int]
    """By agent id: the vehicle that carries the agent's sensor; absent for the roadside unit."""

    def truth(self, ego: str) -> FloatArray:
        """True boxes for an ego: every other vehicle within +-31 m that some agent hits at least 6 times.

        Returns
        -------
        (G, 5) ndarray
            x, y, length, width, yaw in the ego's frame.
        """
        hits = np.max([view.hits for view in self.views.values()], axis=0)
        boxes, index = self.nearby(ego)
        seen: FloatArray = boxes[hits[index] >= TRUTH_MIN_HITS]
        return seen

    def nearby(self, ego: str) -> tuple[FloatArray, IntArray]:
        """All other vehicles within +-31 m of an ego, seen or not: boxes (K, 5) in its frame, and their indices
        (K,).
        """
        boxes = from_world(self.vehicles, self.views[ego].pose)
        near = np.all(np.abs(boxes[:, :2]) <= TRUTH_RANGE_M, axis=1)
        if ego in self.carriers:
            near[self.carriers[ego]] = False
        index = np.flatnonzero(near)
        return boxes[index], index


@dataclass(frozen=True)
class GeneratedScene(ABC):
    """A sequence at 5 Hz with several cars and one roadside unit as agents; a subclass draws the traffic.

    Any frame can be computed by itself; the same seed and index give the same frame, bit for bit. Agents are named
    ``car-1``, ``car-2``, ... and ``rsu``.
    """

    seed: int
    """Any non-negative integer."""
    car_agents: int = 5
    """Cars that carry a sensor."""
    lidar: Lidar = field(default_factory=Lidar)
    length = None
    frame_period_s = FRAME_PERIOD_S

    @cached_property
    def traffic(self) -> Traffic:
        """Where everything is at any time.

        Raises
        ------
        ValueError
            If the seed is no non-negative integer, no car shall carry a sensor, or more than there ever are near each
            other.
        """
        if not isinstance(self.seed, Integral) or self.seed < 0:
            raise ValueError(f"seed must be a non-negative integer, got {self.seed!r}")
        if not isinstance(self.car_agents, Integral):
            raise ValueError(f"car_agents must be a whole number, got {self.car_agents!r}")
        if self.car_agents < 1:
            raise ValueError(f"car_agents must be at least 1, got {self.car_agents}")
        rng = np.random.default_rng([self.seed, 0])
        drawn = (self.draw(rng) for _ in range(DRAWS))
        found = next((traffic for traffic in drawn if traffic is not None), None)
        if found is None:
            raise ValueError(f"car_agents must be fewer: in {DRAWS} draws there were never {self.car_agents} cars near")
        return found

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """Draw the traffic, with as many cars that carry a sensor as there shall be; None if there are too few."""

    @property
    def number(self) -> int:
        """The seed."""
        return self.seed

    @property
    def egos(self) -> tuple[str, ...]:
        """The cars."""
        return tuple(f"car-{i + 1}" for i in range(self.car_agents))

    @property
    def agents(self) -> tuple[str, ...]:
        """Ids of all agents, the cars first."""
        return (*self.egos, "rsu")

    def frame(self, index: int) -> SceneFrame:
        """The views of all agents at time ``index * 0.2 s``.

        Raises
        ------
        ValueError
            If the index is negative, or no integer.
        """
        if not isinstance(index, Integral):
            raise ValueError(f"frame index must be an integer, got {index!r}")
        if index < 0:
            raise ValueError(f"frame index must not be negative, got {index}")
        traffic = self.traffic
        vehicles = traffic.vehicles_at(index * FRAME_PERIOD_S)
        obstacles = np.vstack([np.column_stack([vehicles, traffic.size[:, 2]]), traffic.buildings])
        carriers = {f"car-{i + 1}": int(v) for i, v in enumerate(traffic.agent_vehicles)}
        views = {}
        for number, agent in enumerate(self.agents):
            rng = np.random.default_rng([self.seed, 1 + index, number])
            if agent in carriers:
                carrier = carriers[agent]
                x, y, yaw = vehicles[carrier, [0, 1, 4]]
                height = CAR_SENSOR_HEIGHT_M
                others = np.arange(len(obstacles)) != carrier
            else:
                (x, y, yaw), height = traffic.rsu_pose, RSU_HEIGHT_M
                others = np.ones(len(obstacles), dtype=bool)
            points, hits = self.lidar.scan(obstacles[others], (x, y, height, yaw), rng)
            all_hits = np.zeros(len(obstacles), dtype=np.int64)
            all_hits[others] = hits
            views[agent] = AgentView(pose_matrix(x, y, height, yaw), points, all_hits[: len(vehicles)])
        return SceneFrame(index, vehicles, views, carriers)


@dataclass(frozen=True)
class IntersectionScene(GeneratedScene):
    """A scene at the intersection of `robosac.scenes.world`, with as much traffic as that has by default.

    Examples
    --------
    >>> frame = IntersectionScene(seed=8).frame(0)
    >>> sorted(frame.views)
    ['car-1', 'car-2', 'car-3', 'car-4', 'car-5', 'rsu']
    """

    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """The traffic of `draw_traffic`."""
        return draw_traffic(rng, self.car_agents)


class Synthetic:
    """Scenes of five cars and a roadside unit at the intersection; those of one purpose serve no other."""

    kind = name = "synthetic"

    def scenes(self, split: Split) -> Sequence[IntersectionScene]:
        """A thousand scenes."""
        return [IntersectionScene(seed) for seed in (TEST_SEEDS if split == "test" else VALIDATION_SEEDS)]

    def training_scenes(self) -> Sequence[IntersectionScene]:
        """Those from the first training seeds on."""
        return [IntersectionScene(seed) for seed in TRAINING_SEEDS[:1_000]]
