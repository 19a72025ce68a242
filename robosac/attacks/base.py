"""White-box attacks on messages: one loop, and hooks that make its members.

An attacker v replaces its message M_v by M_v + delta, with ``max |delta| <= epsilon``, to spoil what the ego detects.
Several attackers are optimised jointly. The attack acts on the message as it is sent, before the ego warps it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch.nn import functional

from robosac.detectors.base import AttackSurface

Perturbation = dict[str, torch.Tensor]


def inverted_pseudo_truth(ego_logits: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    """How far an ego's class scores are from the inverse of what it sees alone (0 is reached at the inverse).

    The pseudo ground truth of the paper: the ego-only class scores stand for the unknown truth, and the attacker wants
    each of them inverted, objects erased and background filled.

    Parameters
    ----------
    ego_logits, logits : tensors of one shape
        Class logits of the ego alone and of the attacked fusion.

    Returns
    -------
    scalar tensor
        Mean binary cross-entropy against ``1 - sigmoid(ego_logits)``.
    """
    return functional.binary_cross_entropy_with_logits(logits, 1.0 - torch.sigmoid(ego_logits))


@dataclass(frozen=True)
class IterativeAttack(ABC):
    """Descend an objective for a number of steps, staying within the bound.

    1. ``delta = start()``.
    2. Repeat ``steps`` times: ``delta = project(delta - step_size * normalise(gradient of objective))``.

    Parameters
    ----------
    steps : int
        At least 1.
    step_size : float
        In units of the message.
    epsilon : float
        L-infinity bound on the perturbation, in units of the message.

    Raises
    ------
    ValueError
        If a parameter is not positive.
    """

    name: ClassVar[str]

    steps: int = 15
    step_size: float = 0.1
    epsilon: float = 0.5

    def __post_init__(self) -> None:
        for parameter in ("steps", "step_size", "epsilon"):
            if not getattr(self, parameter) > 0:
                raise ValueError(f"{parameter} must be positive, got {getattr(self, parameter)}")

    def run(
        self, surface: AttackSurface, attackers: Collection[str], rng: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        """Optimise the attackers' messages jointly.

        Parameters
        ----------
        surface : AttackSurface
            The frame with everybody's benign message.
        attackers : collection of str
            Teammates under the adversary's control.
        rng : numpy.random.Generator

        Returns
        -------
        mapping of attacker to tensor
            The messages to send instead, of the shape of the benign ones.

        Raises
        ------
        KeyError
            If an attacker has no message in the frame.
        """
        clean = {name: surface.messages[name] for name in sorted(attackers)}
        if not clean:
            return {}
        delta = self.project(self.start(clean, rng))
        with torch.no_grad():
            ego_logits = surface.class_logits({})
        for _ in range(self.steps):
            variables = {name: d.detach().requires_grad_(True) for name, d in delta.items()}
            attacked = {name: clean[name] + d for name, d in variables.items()}
            loss = self.objective(ego_logits, surface.class_logits({**surface.messages, **attacked}))
            gradients = torch.autograd.grad(loss, list(variables.values()))
            with torch.no_grad():
                delta = self.project(
                    {
                        name: d - self.step_size * self.normalise(g)
                        for (name, d), g in zip(variables.items(), gradients, strict=True)
                    }
                )
        return {name: (clean[name] + delta[name]).detach() for name in clean}

    @abstractmethod
    def start(self, clean: Mapping[str, torch.Tensor], rng: np.random.Generator) -> Perturbation:
        """The first perturbation; it is projected before use."""

    def objective(self, ego_logits: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
        """What the adversary minimises; by default `inverted_pseudo_truth`."""
        return inverted_pseudo_truth(ego_logits, logits)

    def normalise(self, gradient: torch.Tensor) -> torch.Tensor:
        """The direction of a step; by default the sign, the steepest descent under an L-infinity bound."""
        return gradient.sign()

    def project(self, delta: Perturbation) -> Perturbation:
        """The nearest perturbation within the bound."""
        return {name: d.clamp(-self.epsilon, self.epsilon) for name, d in delta.items()}
