"""Attacks that look honest in some fusions, so that the blame falls on somebody else.

A message is the same in every fusion. What it does there depends on the messages that it is fused with. So an attack
can strike in the fusion of the whole team and behave in others.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import torch

from robosac.attacks.base import Tensors, Term
from robosac.attacks.geometric import Perception, unnoticed
from robosac.detectors.base import AttackSurface

CALM = 0.5
"""Weight of looking honest, where the harm in the fusion of the whole team has the weight 1."""


Alibi = Callable[[Sequence[str], Collection[str]], list[list[str]]]
"""Of a team and its attackers, the parts of the team, attackers in each, whose fusion should look as if all were
honest.
"""


def covering(team: Sequence[str], attackers: Collection[str]) -> list[list[str]]:
    """Strike only together: behave in the team without each attacker in turn, and alone.

    Whoever looks for a single culprit finds none: each attacker tested without the others is as good as honest, and
    leaving out either heals the fusion. An attacker without accomplices has no cover and simply attacks.
    """
    if len(attackers) < 2:
        return []
    return [[name for name in team if name != left_out] for left_out in attackers] + [[name] for name in attackers]


def framing(team: Sequence[str], attackers: Collection[str]) -> list[list[str]]:
    """Strike only where the victim is fused too, the first honest teammate by name. Leaving it out then heals the
    fusion.
    """
    victim = min(set(team) - set(attackers), default=None)
    return [] if victim is None else [[name for name in team if name != victim], sorted(attackers)]


def keeping(alibi: Alibi, surface: AttackSurface, attackers: Collection[str]) -> list[Term]:
    """What an attack with an alibi minimises besides its aim: ``CALM * mean of unnoticed(part)`` over the parts in
    which to behave; nothing if there are none.

    Raises
    ------
    NoGeometry
        If there is an alibi to keep, and the surface does not show boxes.
    """
    parts = [(part, Perception.of(surface, part)) for part in alibi(sorted(surface.messages), attackers)]

    def term(sent: Tensors) -> torch.Tensor:
        return CALM * torch.stack([unnoticed(surface, part, sent, honest) for part, honest in parts]).mean()

    return [term] if parts else []
