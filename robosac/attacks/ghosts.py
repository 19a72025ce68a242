"""Cars that do not exist: parked, driving, in the ego's path, one or several."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robosac.attacks.objects import OnObjects, Scope
from robosac.attacks.places import lane_places, path_places
from robosac.attacks.situation import Lie, Situation
from robosac.boxes import FloatArray

AREA_M = 30.0
"""A made-up object that is farther than this from the ego along an axis is given up, and another one is made up."""
CROWDED_M = 3.0
"""So is one that drives, if a vehicle is nearer to it than this."""
SPEED_M_S = 6.0
"""Of a driving object that follows nobody who drives."""
DRIVES_M_S = 1.0
"""A vehicle from this speed on counts as one that drives."""
MOST = 10
_STANDING, _DRIVING = "standing", "driving"


@dataclass(frozen=True)
class Ghost(OnObjects):
    """One car that does not exist, parked in a lane.

    It stands on the line of a true vehicle's heading, 8 to 14 m ahead of it or behind it, at least 5 m from every
    vehicle and agent, within 25 m of the ego, and where nobody sees anything. It stays there, in the world.
    """

    name: ClassVar[str] = "ghost"

    @property
    def count(self) -> int:
        """How many, at most."""
        return 1

    def lies(self, scope: Scope, rng: np.random.Generator) -> list[Lie]:
        """Those of the frame before that are still around the ego, and others for those that are not."""
        situation = scope.situation
        standing: dict[int, FloatArray] = situation.memory.setdefault(_STANDING, {})
        around = {n: situation.around_ego(box[None])[0] for n, box in standing.items()}
        around = {n: box for n, box in around.items() if np.abs(box[:2]).max() <= AREA_M}
        taken = scope.room
        for number in range(self.count):
            if number not in around:
                places = taken.free(self.places(situation, rng), list(around.values()))
                if len(places):
                    around[number] = places[rng.integers(len(places))][:5]
                    standing[number] = situation.in_world(around[number][None])[0]
        return [Lie("ghost", box, number) for number, box in sorted(around.items())]

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Where one might stand, free or not: (n, 5+), ego frame."""
        return lane_places(situation.truth)


@dataclass(frozen=True)
class GhostAhead(Ghost):
    """One car that does not exist, in the ego's path: 7 to 15 m ahead of where it is in the first frame."""

    name: ClassVar[str] = "ghost-ahead"

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Straight ahead."""
        return path_places()
