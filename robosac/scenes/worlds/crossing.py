"""The intersection of `robosac.scenes.world`, with as much and as fast traffic as is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robosac.scenes.intersection import GeneratedScene
from robosac.scenes.world import PLAIN_FLOW, Flow, Speeds, Traffic, draw_traffic
from robosac.scenes.worlds.density import Density

FLOWS: Mapping[Density, Flow] = {
    "sparse": Flow(gap_m=20.0, more_gap_m=20.0, queue=(1, 2), tail_share=0.2, parked_share=0.15),
    "plain": PLAIN_FLOW,
    "dense": Flow(gap_m=10.5, more_gap_m=1.5, queue=(4, 6), tail_share=1.0, parked_share=0.6, truck_share=0.25),
    "jammed": Flow((0.0, 2.0), gap_m=10.5, more_gap_m=0.7, queue=(5, 6), tail_share=1.0, parked_share=0.6),
}
"""By density; a gap is never below 10.5 m, as lorries are up to 9.5 m long."""


@dataclass(frozen=True)
class Crossing(GeneratedScene):
    """Two roads of which one flows and one waits; plain, it is `IntersectionScene`, bit for bit."""

    density: Density = "plain"
    speed_mps: Speeds | None = None
    """Of the flowing axis; by default that of the density."""

    def draw(self, rng: np.random.Generator) -> Traffic | None:
        """The traffic of `draw_traffic` with another flow."""
        flow = FLOWS[self.density]
        if self.speed_mps is not None:
            flow = replace(flow, speed_mps=self.speed_mps)
        return draw_traffic(rng, self.car_agents, flow)
