"""Attacks that know the defence, and move no boxes but those that they have to."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

import torch

from robosac.attacks.adaptive import Erase, Invent, Shift
from robosac.attacks.base import SEEN, Aim, IterativeAttack, Tensors
from robosac.attacks.geometric import CERTAIN, SHOWN, Perception, displacement, geometric
from robosac.attacks.situation import Situation
from robosac.detectors.base import AttackSurface

STILLNESS = 2.0
"""Weight of the boxes that should not move, where the attack's own aim has the weight 1."""


@dataclass(frozen=True)
class HoldingStill(IterativeAttack):
    """Add to an attack's aim how far it moves boxes that it could leave alone.

    An adversarial map shakes all boxes a little. A defence can notice: it compares where the boxes of a subset T lie
    before and after a teammate joins. So this adds, times `STILLNESS`, the mean `displacement` of the certain boxes of
    T in the fusion with the attackers: for T all honest teammates, and for T nobody (the ego alone). Steps are smaller
    and more than elsewhere, since a signed step of 0.1 shakes the boxes by itself.
    """

    needs: ClassVar[tuple[str, ...]] = SHOWN

    steps: int = 30
    step_size: float = 0.04

    everything: ClassVar[bool] = False
    """Whether boxes that only teammates see should stay, too."""

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:
        """The attack's own aim and the term that holds still."""
        harm, shown = super().aim(surface, attackers, situation), geometric(surface)
        ego = Perception.of(surface, ())
        honest = Perception.of(surface, [name for name in surface.messages if name not in attackers])
        held = honest.scores >= CERTAIN
        if not self.everything:
            held = held & (ego.scores >= SEEN)

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:
            _, among_all = shown.perceive({**surface.messages, **sent})
            _, alone = shown.perceive(sent)
            shaken = displacement(among_all, honest.geometry, held)
            shaken = shaken + displacement(alone, ego.geometry, ego.scores >= CERTAIN)
            return harm(sent, delta) + STILLNESS * shaken

        return loss


@dataclass(frozen=True)
class EraseStill(HoldingStill, Erase):
    """`Erase`, while what the ego sees stays where it is."""

    name: ClassVar[str] = "erase-still"


@dataclass(frozen=True)
class InventStill(HoldingStill, Invent):
    """`Invent`, while all that is seen stays where it is."""

    name: ClassVar[str] = "invent-still"
    everything: ClassVar[bool] = True


@dataclass(frozen=True)
class ShiftStill(HoldingStill, Shift):
    """`Shift`, while what the ego sees stays where it is."""

    name: ClassVar[str] = "shift-still"
