"""Projected gradient descent (Madry et al., 2018)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import IterativeAttack, Perturbation


class PGD(IterativeAttack):
    """Signed gradient steps from a random start in the L-infinity ball.

    Defaults are those of the paper's experiments: 15 steps of 0.1 within 0.5.
    """

    name: ClassVar[str] = "pgd"

    def start(self, clean: Mapping[str, torch.Tensor], rng: np.random.Generator) -> Perturbation:
        """Uniform in the ball."""
        return {
            name: torch.from_numpy(rng.uniform(-self.epsilon, self.epsilon, tuple(tensor.shape)).astype(np.float32))
            for name, tensor in clean.items()
        }
