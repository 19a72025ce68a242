"""Signed gradient descent: PGD and BIM."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import IterativeAttack, Tensors


class PGD(IterativeAttack):
    """Projected gradient descent (Madry et al., 2018): signed steps from a random start in the L-infinity ball.

    Defaults are those of the paper's experiments: 15 steps of 0.1 within 0.5.
    """

    name: ClassVar[str] = "pgd"

    def start(self, clean: Tensors, rng: np.random.Generator) -> dict[str, torch.Tensor]:
        """Uniform in the ball."""
        return {
            name: torch.from_numpy(rng.uniform(-self.epsilon, self.epsilon, tuple(tensor.shape)).astype(np.float32))
            for name, tensor in clean.items()
        }


class BIM(IterativeAttack):
    """Basic iterative method (Kurakin et al., 2018): signed steps from the benign message itself."""

    name: ClassVar[str] = "bim"
