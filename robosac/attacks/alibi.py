"""Attacks that look honest in some fusions, so that the blame falls on somebody else.

A message is the same in every fusion. What it does there depends on the messages that it is fused with. So an attack
can strike in the fusion of the whole team and behave in others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch

from robosac.attacks.base import Aim, IterativeAttack, Tensors
from robosac.attacks.geometric import Perception, unnoticed
from robosac.detectors.base import AttackSurface

CALM = 0.5
"""Weight of looking honest, where the harm in the fusion of the whole team has the weight 1."""


class Alibi(Protocol):
    """Chooses the fusions in which to behave."""

    def teams(self, team: Sequence[str], attackers: Collection[str]) -> list[list[str]]:
        """Parts of the team, attackers in each, whose fusion should look as if all were honest."""
        ...


@dataclass(frozen=True)
class Covering:
    """Strike only together: with any one attacker left out, the others behave.

    Whoever looks for a single culprit finds none: each attacker tested without the others is as good as honest, and
    leaving out either heals the fusion. An attacker without accomplices has no cover and simply attacks.
    """

    def teams(self, team: Sequence[str], attackers: Collection[str]) -> list[list[str]]:
        """The team without each attacker in turn, and each attacker alone."""
        if len(attackers) < 2:
            return []
        return [[name for name in team if name != left_out] for left_out in attackers] + [[name] for name in attackers]


@dataclass(frozen=True)
class Framing:
    """Strike only where a chosen victim is fused too. Leaving out the victim then heals the fusion.

    Parameters
    ----------
    victim : str, optional
        An honest teammate; by default the first one by name.
    """

    victim: str | None = None

    def teams(self, team: Sequence[str], attackers: Collection[str]) -> list[list[str]]:
        """The team without the victim, and the attackers alone; none where the victim is not in the team."""
        honest = sorted(set(team) - set(attackers))
        victim = honest[0] if self.victim is None and honest else self.victim
        if victim not in honest:
            return []
        return [[name for name in team if name != victim], sorted(attackers)]


def with_alibi(attack: IterativeAttack, alibi: Alibi, surface: AttackSurface, attackers: Collection[str]) -> Aim:
    """An attack's aim with an alibi: ``aim + CALM * mean of unnoticed(part)`` over the parts in which to behave.

    Raises
    ------
    NoGeometry
        If there is an alibi to keep, and the surface does not show boxes.
    """
    harm = attack.aim(surface, attackers)
    parts = [(part, Perception.of(surface, part)) for part in alibi.teams(sorted(surface.messages), attackers)]
    if not parts:
        return harm

    def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:
        noticed = torch.stack([unnoticed(surface, part, sent, honest) for part, honest in parts]).mean()
        return harm(sent, delta) + CALM * noticed

    return loss
