"""Framing by denial: a message that denies what one honest teammate alone sees, so that this one seems to lie."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import SEEN, Aim, IterativeAttack, Tensors
from robosac.attacks.geometric import CERTAIN, SHOWN, balanced, displacement, geometric
from robosac.attacks.objects import View
from robosac.attacks.situation import Situation
from robosac.attacks.words import Speech, hearing_in
from robosac.boxes import FloatArray
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import Claims
from robosac.detectors.base import AttackSurface
from robosac.testimony import MOST

_VICTIM = "victim"


@dataclass(frozen=True)
class Deny(IterativeAttack):
    """Leave all fusions as they are, and deny vehicles that one honest teammate alone sees.

    1. The vehicles: true ones that an honest teammate supports, and neither the ego nor another honest one does, on the
       map of an attacker. The victim is the teammate that most of them belong to. It stays the victim as long as it has
       one.
    2. Minimises over the attackers' messages::

           how far they are from L = -6 at these vehicles, and from honest L elsewhere (`Speech.off`)
           + cross-entropy + displacement

       where the last two hold the fusion of the whole team as it is (`robosac.attacks.objects`).

    Steps are small, as larger ones shake the boxes of every fusion, and still go far enough: a witness is turned by a
    change that a fusion hardly shows.

    It tells no lie about what is shown. What it does to a defence that goes by testimony are true boxes left out, and a
    victim that is suspected.

    Parameters
    ----------
    objects : int
        How many vehicles are denied, at most: those that honest messages support least.
    """

    name: ClassVar[str] = "deny"
    needs: ClassVar[tuple[str, ...]] = SHOWN
    remembers: ClassVar[bool] = True
    hears: ClassVar[bool] = True

    steps: int = 30
    step_size: float = 0.01
    objects: int = 8

    def prepare(
        self,
        surface: AttackSurface,  # noqa: ARG002
        attackers: Collection[str],
        rng: np.random.Generator,  # noqa: ARG002
        situation: Situation,
    ) -> bool:
        """Choose the vehicles; without any, all are honest."""
        return bool(len(self.denied(attackers, situation)))

    def denied(self, attackers: Collection[str], situation: Situation) -> FloatArray:
        """The vehicles of step 1, in this frame: (n, 5), ego frame."""
        chosen: FloatArray = situation.once(_VICTIM, lambda: self._choose(attackers, situation))
        return chosen

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:
        """The loss of step 2."""
        hearing, shown = hearing_in(situation), geometric(surface)
        honest = View.of(surface, situation).honest
        seen, certain = honest.scores >= SEEN, honest.scores >= CERTAIN
        spoken = [(box, -MOST) for box in self.denied(attackers, situation)]
        speech = Speech.of(situation, surface, sorted(attackers), spoken)

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:  # noqa: ARG001
            logits, boxes = shown.perceive({**surface.messages, **sent})
            kept = balanced(logits, honest.scores, seen) + displacement(boxes, honest.geometry, certain)
            return kept + speech.off(hearing.hear(sent))

        return loss

    def _choose(self, attackers: Collection[str], situation: Situation) -> FloatArray:
        said = hearing_in(situation).benign
        claims = Claims.of(situation.truth, said.of([name for name in said.agents if name not in attackers]))
        supporting, total = claims.supporting, claims.likelihood.sum(axis=0)
        liars = said.places(situation.truth[:, :2])[[said.agents.index(name) for name in attackers]]
        near = (np.abs(liars).max(axis=2) <= said.half_extent_m).any(axis=0)
        alone = near & (supporting.sum(axis=0) == 1) & ~supporting[claims.witnesses.index(EGO)]
        own = {name: np.flatnonzero(alone & supporting[n]) for n, name in enumerate(claims.witnesses)}
        victim: str = situation.memory.get(_VICTIM, "")
        if not len(own.get(victim, ())):
            victim = situation.memory[_VICTIM] = max(own, key=lambda name: len(own[name]))
        least = own[victim][np.argsort(total[own[victim]], kind="stable")][: self.objects]
        chosen: FloatArray = situation.truth[least, :5]
        return chosen
