"""The worlds that ship, by name: this table is the only place that lists them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from robosac.scenes.base import Scene
from robosac.scenes.disturbances import Biased, Dropped, JumpingEgo, Late, NarrowEgo, NoisyScanner, Rain
from robosac.scenes.lidar import Lidar
from robosac.scenes.worlds.car_park import CarPark
from robosac.scenes.worlds.crossing import Crossing
from robosac.scenes.worlds.highway import Highway
from robosac.scenes.worlds.roundabout import Roundabout

Layout = Callable[[int], Scene]
"""Makes the scene of a seed."""
FAST_MPS = (11.0, 15.0)


@dataclass(frozen=True)
class Recipe:
    """What a world is made of."""

    layout: Layout
    """With density, speed and sensor, where they are not the plain ones."""
    disturbances: tuple[Callable[[Scene], Scene], ...] = ()
    """Put around the scene, the first one innermost."""

    def scene(self, seed: int) -> Scene:
        """The scene of a seed."""
        scene = self.layout(seed)
        for disturbance in self.disturbances:
            scene = disturbance(scene)
        return scene


WORLDS: Mapping[str, Recipe] = {
    "crossing": Recipe(Crossing),
    "crossing-sparse": Recipe(partial(Crossing, density="sparse")),
    "crossing-dense": Recipe(partial(Crossing, density="dense")),
    "crossing-jammed": Recipe(partial(Crossing, density="jammed")),
    "crossing-fast": Recipe(partial(Crossing, speed_mps=FAST_MPS)),
    "crossing-dense-fast": Recipe(partial(Crossing, density="dense", speed_mps=FAST_MPS)),
    "highway": Recipe(Highway),
    "highway-dense": Recipe(partial(Highway, density="dense")),
    "highway-jammed": Recipe(partial(Highway, density="jammed")),
    "roundabout": Recipe(Roundabout),
    "roundabout-dense": Recipe(partial(Roundabout, density="dense")),
    "car-park": Recipe(CarPark),
    "crossing-14-beams": Recipe(partial(Crossing, lidar=Lidar(beams=14))),
    "crossing-64-beams": Recipe(partial(Crossing, lidar=Lidar(beams=64))),
    "crossing-short-range": Recipe(partial(Crossing, lidar=Lidar(range_m=30.0))),
    "crossing-rain": Recipe(Crossing, (Rain,)),
    "crossing-noisy-scanner": Recipe(Crossing, (NoisyScanner,)),
    "crossing-late": Recipe(Crossing, (Late,)),
    "crossing-late-old-pose": Recipe(Crossing, (partial(Late, fresh_pose=False),)),
    "crossing-all-late": Recipe(Crossing, (partial(Late, everybody=True),)),
    "crossing-dropped": Recipe(Crossing, (Dropped,)),
    "crossing-biased": Recipe(Crossing, (Biased,)),
    "crossing-jumping-ego": Recipe(Crossing, (JumpingEgo,)),
    "crossing-narrow-ego": Recipe(Crossing, (NarrowEgo,)),
}
