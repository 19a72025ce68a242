"""The attack of Carlini and Wagner (2017), carried over to detection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from robosac.attacks.base import IterativeAttack, Knowledge, Tensors


@dataclass(frozen=True)
class CarliniWagner(IterativeAttack):
    """Least perturbation that flips the classes, by Adam on a change of variable.

    Minimises ``sum(delta^2) + trade_off * sum of max(margin, -confidence)`` over the cells. The margin of a cell is how
    far the class that the ego alone sees there leads over the other, ``y * logit`` with y = 1 for an object and -1 for
    background. The change of variable ``delta = epsilon * tanh(w)`` keeps the L-infinity bound by construction, as that
    of the original keeps pixels in their range.

    Parameters
    ----------
    steps : int
        30 in the paper's experiments.
    step_size : float
        Adam's learning rate on w.
    trade_off : float
        c of the original: what flipped cells are worth against a small perturbation.
    confidence : float
        kappa of the original: how far beyond the decision boundary a cell is pushed.
    """

    name: ClassVar[str] = "cw"

    steps: int = 30
    trade_off: float = 10.0
    confidence: float = 3.0

    def objective(self, known: Knowledge, logits: torch.Tensor, delta: Tensors) -> torch.Tensor:
        """Squared size of the perturbation and the margins not yet lost."""
        margin = torch.where(known.ego_logits >= 0, logits, -logits)
        size = torch.stack([d.square().sum() for d in delta.values()]).sum()
        return size + self.trade_off * margin.clamp(min=-self.confidence).sum()

    def perturbation(self, variable: torch.Tensor) -> torch.Tensor:
        """``epsilon * tanh(w)``."""
        return self.epsilon * torch.tanh(variable)

    def optimiser(self, variables: list[torch.Tensor]) -> torch.optim.Optimizer:
        """Adam, as in the original."""
        return torch.optim.Adam(variables, lr=self.step_size)

    def normalise(self, gradient: torch.Tensor) -> torch.Tensor:
        """The gradient itself; Adam scales it."""
        return gradient

    def project(self, variable: torch.Tensor) -> torch.Tensor:
        """The variable itself; the bound holds by construction."""
        return variable
