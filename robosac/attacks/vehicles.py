"""Attacks on cars that exist: erased, shown elsewhere or otherwise, or shown twice."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robosac.attacks.base import SEEN
from robosac.attacks.geometric import CERTAIN
from robosac.attacks.objects import NEAR_M, OnObjects, Scope
from robosac.attacks.places import Followed, heard
from robosac.attacks.situation import Lie
from robosac.boxes import BoolArray, FloatArray

AREA_M = 30.0
"""A car that is farther than this from the ego along an axis is given up, and another one is chosen."""
SHOWN_M = 1.5
"""A box centred so near to a car shows it."""
ROOM_M, CROWDED_M = 4.0, 3.0
"""From a ghost beside a car to all others: at least, when it appears, and afterwards."""
_FOLLOWED, _FRAME = "followed", "frame"


@dataclass(frozen=True)
class OnVehicles(OnObjects):
    """Lies about true cars that the ego alone does not see and the honest fusion does.

    They are chosen in the first frame, and followed in the world while they last; then others are chosen. They lie
    within reach of an attacker's map when they are chosen.
    """

    @property
    def count(self) -> int:
        """How many, at most."""
        return 1

    @abstractmethod
    def lie(self, box: FloatArray, number: int) -> Lie:
        """What is said of a car (5,); ego frame."""

    def lies(self, scope: Scope, rng: np.random.Generator) -> list[Lie]:
        """One for each car that is followed."""
        situation, memory = scope.situation, scope.situation.memory
        elapsed_s = (situation.frame - memory.get(_FRAME, situation.frame)) * situation.period_s
        world = situation.in_world(situation.truth)
        followed: dict[int, Followed] = {}
        for number, car in memory.get(_FOLLOWED, {}).items():
            now = car.among(world, elapsed_s) if elapsed_s > 0 else car
            if now is not None and self._lasts(scope, situation.around_ego(now.box[None])):
                followed[number] = now
        self._choose(scope, followed, rng)
        memory[_FOLLOWED], memory[_FRAME] = followed, situation.frame
        boxes = {number: situation.around_ego(car.box[None])[0] for number, car in sorted(followed.items())}
        return [self.lie(box, number) for number, box in boxes.items()]

    def _choose(self, scope: Scope, followed: dict[int, Followed], rng: np.random.Generator) -> None:
        """Cars for the numbers that have none."""
        missing = [number for number in range(self.count) if number not in followed]
        if not missing:
            return
        truth, view = scope.situation.truth, scope.view
        taken = scope.situation.around_ego(np.array([car.box for car in followed.values()]).reshape(-1, 5))
        fits = self.fits(scope, truth) & (_distance(truth, view.shown(view.honest, CERTAIN)) <= SHOWN_M)
        fits &= _distance(truth, taken[:, :2]) > NEAR_M
        fits &= heard(truth, scope.liars) & (np.abs(truth[:, :2]).max(axis=1, initial=0.0) <= AREA_M)
        for number, index in zip(missing, rng.permutation(np.flatnonzero(fits)), strict=False):
            followed[number] = Followed(scope.situation.in_world(truth[index][None])[0])

    def fits(self, scope: Scope, cars: FloatArray) -> BoolArray:
        """Which cars (n, 5), ego frame, may be lied about, of those that the honest fusion shows."""
        unseen: BoolArray = _distance(cars, scope.view.shown(scope.view.ego, SEEN)) > NEAR_M
        return unseen

    def _lasts(self, scope: Scope, car: FloatArray) -> bool:  # noqa: ARG002
        """Whether a car (1, 5), ego frame, that was lied about is lied about further."""
        return bool(np.abs(car[0, :2]).max() <= AREA_M)


def _distance(boxes: FloatArray, points: FloatArray) -> FloatArray:
    """Distance (n,) of the centres of boxes (n, 5) from the nearest of some points (m, 2)."""
    apart = np.linalg.norm(boxes[:, None, :2] - points[None], axis=2)
    nearest: FloatArray = apart.min(axis=1, initial=np.inf)
    return nearest


@dataclass(frozen=True)
class Remove(OnVehicles):
    """Erase one car that the ego alone does not see."""

    name: ClassVar[str] = "remove"

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That there is nothing."""
        return Lie("erased", box, number)


@dataclass(frozen=True)
class RemoveMany(Remove):
    """Erase several cars that the ego alone does not see.

    Parameters
    ----------
    objects : int
        How many, at most.
    """

    name: ClassVar[str] = "remove-many"

    objects: int = 8

    @property
    def count(self) -> int:
        """As many as it is told."""
        return self.objects


@dataclass(frozen=True)
class Dim(OnVehicles):
    """Show one car that the ego alone does not see with so low a score that nobody counts it."""

    name: ClassVar[str] = "dim"

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That it is hardly there."""
        return Lie("dimmed", box, number)


@dataclass(frozen=True)
class Displace(OnVehicles):
    """Show one car that the ego alone does not see to its left of where it is.

    Parameters
    ----------
    distance : float
        Metres.
    """

    name: ClassVar[str] = "displace"

    distance: float = 1.2

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That it is there."""
        moved = np.array(box)
        moved[:2] += self.distance * self.way(float(box[4]))
        return Lie("moved", moved, number, box)

    def way(self, yaw: float) -> FloatArray:
        """Where to (2,) a car that heads so is moved."""
        return np.array([-np.sin(yaw), np.cos(yaw)])


@dataclass(frozen=True)
class Jump(Displace):
    """Show such a car ahead of where it is, by less than its length: its place does not look empty."""

    name: ClassVar[str] = "jump"

    distance: float = 3.3

    def way(self, yaw: float) -> FloatArray:
        """Ahead."""
        return np.array([np.cos(yaw), np.sin(yaw)])


@dataclass(frozen=True)
class Turn(OnVehicles):
    """Show one car that the ego alone does not see with another heading.

    Parameters
    ----------
    angle : float
        By how much, to the left; radians.
    """

    name: ClassVar[str] = "turn"

    angle: float = np.pi / 4

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That it heads there."""
        turned = np.array(box)
        turned[4] += self.angle
        return Lie("reshaped", turned, number, box)


@dataclass(frozen=True)
class Stretch(OnVehicles):
    """Show one car that the ego alone does not see larger than it is.

    Parameters
    ----------
    times : float
        Its sides.
    """

    name: ClassVar[str] = "stretch"

    times: float = 1.7

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That it is so large."""
        return Lie("reshaped", box * [1.0, 1.0, self.times, self.times, 1.0], number, box)


@dataclass(frozen=True)
class GhostBeside(Displace):
    """One car that does not exist, to the left of a true one, headed and driving as it does.

    Who sees the true car sees a vehicle almost there. The ghost is at least 4 m from every other vehicle and every
    agent when it appears. Once it is nearer than 3 m to one, it is given up for another.

    Parameters
    ----------
    distance : float
        Metres between the centres.
    """

    name: ClassVar[str] = "ghost-beside"

    distance: float = 3.0

    def lie(self, box: FloatArray, number: int) -> Lie:
        """That there is one."""
        return Lie("ghost", super().lie(box, number).box, number)

    def fits(self, scope: Scope, cars: FloatArray) -> BoolArray:
        """Those with room beside them."""
        fits: BoolArray = self._room_m(scope, cars) >= ROOM_M
        return fits

    def _lasts(self, scope: Scope, car: FloatArray) -> bool:
        return super()._lasts(scope, car) and bool(self._room_m(scope, car)[0] >= CROWDED_M)

    def _room_m(self, scope: Scope, cars: FloatArray) -> FloatArray:
        """How far (n,) the ghosts beside cars (n, 5) are from all other vehicles and agents, metres."""
        ghosts = np.array([self.lie(car, 0).box for car in cars]).reshape(-1, 5)
        others = np.linalg.norm(cars[:, None, :2] - scope.situation.truth[None, :, :2], axis=2) > SHOWN_M
        apart = np.linalg.norm(ghosts[:, None, :2] - scope.situation.truth[None, :, :2], axis=2)
        nearest: FloatArray = np.where(others, apart, np.inf).min(axis=1, initial=np.inf)
        return np.minimum(nearest, _distance(ghosts, scope.agents))
