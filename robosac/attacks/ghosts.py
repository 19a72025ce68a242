"""Cars that do not exist: parked, driving, in the ego's path, one or several."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import Aim, Tensors
from robosac.attacks.geometric import geometric
from robosac.attacks.objects import OnObjects, Scope, View, harm
from robosac.attacks.places import Followed, advanced, any_places, lane_places, path_places
from robosac.attacks.situation import Lie, Situation
from robosac.attacks.words import hearing_in
from robosac.boxes import FloatArray
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import Claims
from robosac.detectors.base import AttackSurface

AREA_M = 30.0
"""A made-up object that is farther than this from the ego along an axis is given up, and another one is made up."""
CROWDED_M = 3.0
"""So is one that drives, if a vehicle is nearer to it than this."""
SPEED_M_S = 6.0
"""Of a driving object that follows nobody who drives."""
DRIVES_M_S = 1.0
"""A vehicle from this speed on counts as one that drives."""
KNOWN = 6.0
"""Whoever denies more than this denies no more for it."""
MOST = 10
_STANDING, _DRIVING, _BEFORE, _FRAMED = "standing", "driving", "before", "framed"


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
                    around[number] = places[self.choose(scope, places, rng)][:5]
                    standing[number] = situation.in_world(around[number][None])[0]
        return [Lie("ghost", box, number) for number, box in sorted(around.items())]

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Where one might stand, free or not: (n, 5+), ego frame."""
        return lane_places(situation.truth)

    def choose(self, scope: Scope, places: FloatArray, rng: np.random.Generator) -> int:  # noqa: ARG002
        """Where one stands of free places (n, 5+): the number of the place; by default any."""
        return int(rng.integers(len(places)))


@dataclass(frozen=True)
class GhostHidden(Ghost):
    """One car that does not exist, parked in the free place of `Ghost` that honest messages deny least.

    It is the one where the sum of L over the ego and all honest teammates is highest, each within +-6, as the defence
    would look it up. So it often stands where few can see.
    """

    name: ClassVar[str] = "ghost-hidden"
    hears: ClassVar[bool] = True

    def choose(self, scope: Scope, places: FloatArray, rng: np.random.Generator) -> int:  # noqa: ARG002
        """Where the sum is highest."""
        said = hearing_in(scope.situation).benign
        honest = said.of([name for name in said.agents if name not in scope.attackers])
        return int(Claims.of(places, honest).likelihood.sum(axis=0).argmax())


@dataclass(frozen=True)
class GhostFraming(Ghost):
    """One car that does not exist, to frame the one honest teammate that denies it.

    It is parked where one teammate denies it and all others say little: where ``min(6, -L1) + 3 min(0, L2) - s / 2`` is
    greatest. L1 and L2 are the lowest L of honest messages, and s is the sum of those above 0. The fusion of all hides
    it, and the one without that teammate shows it. So that teammate seems to take away a vehicle that the attackers
    alone see. Where it is not in the frame, this is a `Ghost`.
    """

    name: ClassVar[str] = "ghost-framing"
    hears: ClassVar[bool] = True

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:
        """In the gaps of lanes, and anywhere."""
        return np.vstack([lane_places(situation.truth)[:, :5], any_places(rng)])

    def choose(self, scope: Scope, places: FloatArray, rng: np.random.Generator) -> int:  # noqa: ARG002
        """Where the one stands out; never the ego, which is in every fusion."""
        said = hearing_in(scope.situation).benign
        honest = said.of([name for name in said.agents if name not in scope.attackers])
        claimed = Claims.of(places, honest).likelihood
        ranked = np.sort(claimed, axis=0)
        stands_out = np.minimum(-ranked[0], KNOWN) + 3 * np.minimum(ranked[1:2].sum(axis=0), 0.0)
        stands_out -= 0.5 * np.maximum(ranked[1:], 0.0).sum(axis=0)
        stands_out[claimed.argmin(axis=0) == honest.agents.index(EGO)] = -np.inf
        chosen = int(stands_out.argmax())
        scope.situation.memory[_FRAMED] = honest.agents[int(claimed[:, chosen].argmin())]
        return chosen

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:
        """Hidden in the fusion of all, shown without whom it frames."""
        framed = situation.memory.get(_FRAMED)
        if framed not in surface.messages:
            return super().aim(surface, attackers, situation)
        hiding = replace(situation, lies=[replace(lie, kind="erased") for lie in situation.lies])
        hidden = super().aim(surface, attackers, hiding)
        showing, shown = harm(situation.lies, View.of(surface, situation).honest), geometric(surface)

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:
            messages = {name: map_ for name, map_ in {**surface.messages, **sent}.items() if name != framed}
            return hidden(sent, delta) + showing(*shown.perceive(messages))

        return loss


@dataclass(frozen=True)
class GhostAhead(Ghost):
    """One car that does not exist, in the ego's path: 7 to 15 m ahead of where it is in the first frame."""

    name: ClassVar[str] = "ghost-ahead"

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Straight ahead."""
        return path_places()


@dataclass(frozen=True)
class Ghosts(Ghost):
    """Several cars that do not exist, each as that of `Ghost`, 5 m apart from one another.

    Parameters
    ----------
    objects : int
        How many, at most; one to ten.
    """

    name: ClassVar[str] = "ghosts"

    objects: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.objects > MOST:
            raise ValueError(f"objects must be at most {MOST}, got {self.objects}")

    @property
    def count(self) -> int:
        """As many as it is told."""
        return self.objects


@dataclass(frozen=True)
class Swarm(Ghosts):
    """Several cars that do not exist, anywhere around the ego where it is free, headed anywhere."""

    name: ClassVar[str] = "swarm"

    objects: int = 9

    def places(self, situation: Situation, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Anywhere."""
        return any_places(rng)


@dataclass(frozen=True, eq=False)
class _Drive:
    """A made-up car on its way; world frame."""

    start: FloatArray
    """(5,): where it was in its first frame."""
    since: int
    """The number of that frame."""
    speed: float | None
    leader: Followed | None
    """Whom it follows, until its speed is known; metres per second."""


@dataclass(frozen=True)
class GhostDriving(OnObjects):
    """One car that does not exist, and drives in its lane.

    It appears as that of `Ghost` does. Then it drives on at a constant speed: that of the vehicle in whose lane it
    appeared, from that vehicle's next place, or 6 m/s if that one stands or is lost. Where it comes near to a vehicle
    or leaves the area another one appears, rather in the lane of somebody who drives.
    """

    name: ClassVar[str] = "ghost-driving"

    def lies(self, scope: Scope, rng: np.random.Generator) -> list[Lie]:
        """Where it is by now."""
        situation, memory = scope.situation, scope.situation.memory
        vehicles = situation.in_world(situation.truth)
        drive: _Drive | None = memory.get(_DRIVING)
        frame, before = memory.get(_BEFORE, (situation.frame, None))
        elapsed_s = (situation.frame - frame) * situation.period_s
        if drive is not None:
            drive = _driven_on(drive, vehicles, elapsed_s)
            if not self._has_room(drive, situation, vehicles):
                drive = None
        if drive is None:
            drive = self._begun(scope, None if before is None else _speeds(vehicles, before, elapsed_s), rng)
        memory[_DRIVING], memory[_BEFORE] = drive, (situation.frame, vehicles)
        return [] if drive is None else [Lie("ghost", situation.around_ego(_at(drive, situation)[None])[0])]

    def _has_room(self, drive: _Drive, situation: Situation, vehicles: FloatArray) -> bool:
        box = _at(drive, situation)
        away = np.hypot(*(vehicles[:, :2] - box[:2]).T).min(initial=np.inf)
        return bool(away >= CROWDED_M and np.abs(situation.around_ego(box[None])[0, :2]).max() <= AREA_M)

    def _begun(self, scope: Scope, speeds: FloatArray | None, rng: np.random.Generator) -> _Drive | None:
        """In a lane; ``speeds`` (V,) of all vehicles if they are known."""
        situation = scope.situation
        places = scope.room.free(lane_places(situation.truth))
        leaders = places[:, 5].astype(np.int64)
        if speeds is not None and (driving := speeds[leaders] >= DRIVES_M_S).any():
            places, leaders = places[driving], leaders[driving]
        if not len(places):
            return None
        chosen = rng.integers(len(places))
        leader = situation.in_world(situation.truth[leaders[chosen]][None])[0]
        speed = None if speeds is None else max(float(speeds[leaders[chosen]]), 0.0)
        if speed is not None and speed < DRIVES_M_S:
            speed = SPEED_M_S
        start = situation.in_world(places[chosen, :5][None])[0]
        return _Drive(start, situation.frame, speed, Followed(leader))


def _at(drive: _Drive, situation: Situation) -> FloatArray:
    return advanced(drive.start, (drive.speed or 0.0) * (situation.frame - drive.since) * situation.period_s)


def _driven_on(drive: _Drive, vehicles: FloatArray, elapsed_s: float) -> _Drive:
    """The same drive; its speed is settled in its second frame."""
    if drive.speed is not None or drive.leader is None or elapsed_s <= 0:
        return drive
    leader = drive.leader.among(vehicles, elapsed_s)
    drives = leader is not None and leader.speed is not None and leader.speed >= DRIVES_M_S
    return replace(drive, speed=leader.speed if leader is not None and drives else SPEED_M_S, leader=leader)


def _speeds(now: FloatArray, before: FloatArray, elapsed_s: float) -> FloatArray | None:
    """Speed (V,) of each vehicle along its heading, 0 where it was not there before; None if no time has passed."""
    if elapsed_s <= 0:
        return None
    came = [Followed(box).among(before, elapsed_s) for box in now]
    return np.array([0.0 if each is None else -(each.speed or 0.0) for each in came])
