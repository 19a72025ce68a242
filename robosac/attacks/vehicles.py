"""Attacks on cars that exist: erased, or shown elsewhere."""

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
from robosac.boxes import FloatArray

AREA_M = 30.0
"""A car that is farther than this from the ego along an axis is given up, and another one is chosen."""
SHOWN_M = 1.5
"""A box centred so near to a car shows it."""
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
            if now is not None and np.abs(situation.around_ego(now.box[None])[0, :2]).max() <= AREA_M:
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
        fits = _distance(truth, view.shown(view.ego, SEEN)) > NEAR_M
        fits &= _distance(truth, view.shown(view.honest, CERTAIN)) <= SHOWN_M
        fits &= _distance(truth, taken[:, :2]) > NEAR_M
        fits &= heard(truth, scope.liars) & (np.abs(truth[:, :2]).max(axis=1, initial=0.0) <= AREA_M)
        for number, index in zip(missing, rng.permutation(np.flatnonzero(fits)), strict=False):
            followed[number] = Followed(scope.situation.in_world(truth[index][None])[0])


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
