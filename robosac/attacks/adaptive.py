"""Attacks that know the defence: they leave alone what the ego can check by itself."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch.nn import functional

from robosac.attacks.base import SEEN, Aim, Knowledge, Tensors
from robosac.attacks.geometric import SHOWN, Perception, average, balanced, displacement, geometric
from robosac.attacks.gradient import BIM
from robosac.attacks.situation import Situation
from robosac.detectors.base import AttackSurface

APART_M = 5.0
"""Invented objects keep this far from one another and from everything seen."""
SPACING_M = 8.0
"""Distance between the points where steady invented objects may stand."""
CAR = (1.5, 0.64, 1.0, 0.0)
"""Logarithms of length and width, and the yaw's two numbers, of a car of 4.5 m by 1.9 m that heads as the ego does."""
MAX_PLACES = 5000
"""So many places, the best, are considered for invented objects. It bounds the search where there are many anchors."""


class Erase(BIM):
    """Leave what the ego sees, erase what only its teammates see.

    Descends the cross-entropy between the fusion's class scores and the ego's own, `balanced` over the cells where the
    ego or the benign fusion sees something. The attacked fusion then agrees with the ego more than an honest one does.
    A test that asks only whether it contradicts the ego lets it through.
    """

    name: ClassVar[str] = "erase"

    def objective(self, known: Knowledge, logits: torch.Tensor, delta: Tensors) -> torch.Tensor:  # noqa: ARG002
        """Cross-entropy against the ego-only scores, balanced between what is seen and the background."""
        wanted = torch.sigmoid(known.ego_logits)
        matters = torch.maximum(wanted, torch.sigmoid(known.benign_logits)) >= SEEN
        return balanced(logits, wanted, matters)


@dataclass(frozen=True)
class Invent(BIM):
    """Leave all that is seen, and invent objects where the ego has nothing to set against them.

    1. The places: those least certainly empty to the ego alone, at least 5 m from one another and from everything that
       the ego or the benign fusion sees.
    2. Descends the cross-entropy between the fusion's class scores and the benign ones with a 1 in each place: places,
       other cells where something is seen, and background count equally.

    So many more boxes lower the Jaccard index against the ego, but seldom below the threshold: with n boxes of the ego
    in a benign fusion of m it is about ``n / (m + objects)``, and m is about twice the default.

    Parameters
    ----------
    objects : int
        How many, at most.
    """

    name: ClassVar[str] = "invent"
    needs: ClassVar[tuple[str, ...]] = SHOWN

    objects: int = 12

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:  # noqa: ARG002
        """The loss of step 2."""
        honest = Perception.of(surface, surface.messages)
        with torch.no_grad():
            ego_logits = surface.class_logits({})
        seen = torch.maximum(torch.sigmoid(ego_logits), honest.scores) >= SEEN
        place = self._places(ego_logits, honest.geometry[..., :2], seen)
        background = ~(seen | place)

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:  # noqa: ARG001
            logits = surface.class_logits({**surface.messages, **sent})
            entropy = functional.binary_cross_entropy_with_logits(
                logits, torch.where(place, 1.0, honest.scores), reduction="none"
            )
            return average(entropy, place) + average(entropy, seen) + average(entropy, background)

        return loss

    def _places(self, ego_logits: torch.Tensor, centres: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """Mask of the places of step 1."""
        taken = centres[seen].reshape(-1, 2)
        order = torch.where(seen, -torch.inf, ego_logits).flatten().argsort(descending=True)[:MAX_PLACES]
        chosen = torch.zeros(seen.numel(), dtype=torch.bool)
        flat = centres.reshape(-1, 2)
        for index in order[: int((~seen).sum())].tolist():
            if int(chosen.sum()) == self.objects:
                break
            if bool((torch.linalg.vector_norm(taken - flat[index], dim=1) >= APART_M).all()):
                chosen[index] = True
                taken = torch.cat([taken, flat[index : index + 1]])
        return chosen.reshape(seen.shape)


@dataclass(frozen=True)
class InventSteady(Invent):
    """`Invent`, with objects that are still there in the next frame.

    A defence can compare frames: what is there stays, or drives on. So the places are points of a fixed grid around the
    ego, 8 m apart, the farthest first, and 5 m from everything seen. The loss has another term: how far the objects are
    from cars at these points that head as the ego does. So they drive along with it. Steps are smaller and more than
    elsewhere, since a signed step of 0.1 shakes the boxes by itself.
    """

    name: ClassVar[str] = "invent-steady"

    steps: int = 30
    step_size: float = 0.04

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:
        """The aim of `Invent`, and the objects at their points."""
        harm, shown = super().aim(surface, attackers, situation), geometric(surface)
        ego, honest = Perception.of(surface, ()), Perception.of(surface, surface.messages)
        seen = torch.maximum(ego.scores, honest.scores) >= SEEN
        cells, points = self._points(honest.geometry[..., :2], seen)
        wanted = torch.cat([points, torch.tensor(CAR).expand(len(points), -1)], dim=1)
        everywhere = torch.ones(len(points), dtype=torch.bool)

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:
            _, geometry = shown.perceive({**surface.messages, **sent})
            return harm(sent, delta) + displacement(geometry.reshape(-1, 6)[cells], wanted, everywhere)

        return loss

    def _places(self, ego_logits: torch.Tensor, centres: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        chosen = torch.zeros(seen.numel(), dtype=torch.bool)
        chosen[self._points(centres, seen)[0]] = True
        return chosen.reshape(seen.shape)

    def _points(self, centres: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Points (n, 2) and the numbers (n,) of the places nearest to them."""
        flat = centres.reshape(-1, 2)
        steps = int(flat.abs().max() // SPACING_M)
        side = SPACING_M * torch.arange(-steps, steps + 1.0)
        points = torch.cartesian_prod(side, side)
        points = points[points.norm(dim=1).argsort(descending=True, stable=True)]
        apart = (
            torch.cdist(points, flat[seen.flatten()]).min(dim=1).values
            if bool(seen.any())
            else points[:, 0] + torch.inf
        )
        points = points[apart >= APART_M][: self.objects]
        distance = torch.cdist(points, flat)
        distance[:, seen.flatten()] = torch.inf
        return distance.argmin(dim=1), points


@dataclass(frozen=True)
class Shift(BIM):
    """Leave what the ego sees, and move what only its teammates see to the side.

    Descends ``displacement + cross-entropy``: the boxes that the benign fusion is certain of and the ego alone does not
    see should lie ``distance`` metres to their left, and every class score should be as in the benign fusion. No box
    appears or disappears, so that counting and matching at IoU 0.5 tell little.

    Parameters
    ----------
    distance : float
        Metres; under one.
    """

    name: ClassVar[str] = "shift"
    needs: ClassVar[tuple[str, ...]] = SHOWN

    distance: float = 0.9

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:  # noqa: ARG002
        """Boxes at other places, scores as they were."""
        shown = geometric(surface)
        ego, honest = Perception.of(surface, ()), Perception.of(surface, surface.messages)
        seen = honest.scores >= SEEN
        moved = seen & (ego.scores < SEEN)
        heading = torch.atan2(honest.geometry[..., 5], honest.geometry[..., 4]) / 2
        left = torch.stack([-heading.sin(), heading.cos()], dim=-1)
        wanted = honest.geometry[..., :2] + self.distance * left

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:  # noqa: ARG001
            logits, geometry = shown.perceive({**surface.messages, **sent})
            away = (geometry[..., :2] - wanted).abs().sum(dim=-1)
            return average(away, moved) + balanced(logits, honest.scores, seen)

        return loss
