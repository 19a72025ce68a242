"""A control: noise that nobody optimised."""

from __future__ import annotations

from collections.abc import Collection
from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import Attack
from robosac.attacks.returned import of_attackers
from robosac.attacks.situation import Situation
from robosac.detectors.base import AttackSurface


class GaussianNoise(Attack):
    """Independent Gaussian noise with standard deviation epsilon, cut off at the bound."""

    name: ClassVar[str] = "noise"

    def run(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,
        situation: Situation | None = None,  # noqa: ARG002
    ) -> dict[str, torch.Tensor]:
        """Add the noise."""
        sent = {}
        for name, clean in of_attackers(surface.messages, attackers).items():
            noise = torch.from_numpy(rng.normal(0.0, self.epsilon, tuple(clean.shape)).astype(np.float32))
            sent[name] = clean + noise.clamp(-self.epsilon, self.epsilon)
        return sent
