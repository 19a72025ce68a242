"""Attacks that know the defence."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch.nn import functional

from robosac.attacks.base import Knowledge, Tensors
from robosac.attacks.gradient import BIM

SEEN = 0.1
"""A cell with a score from here on counts as one where something is seen."""


class Erase(BIM):
    """Leave what the ego sees, erase what only its teammates see.

    Descends the cross-entropy between the fusion's class scores and the ego's own. Cells where the ego or the benign
    fusion sees something count as much together as all others, which are many and empty. The attacked fusion then
    agrees with the ego more than an honest one does, so a test that asks only whether it contradicts the ego lets it
    through.
    """

    name: ClassVar[str] = "erase"

    def objective(self, known: Knowledge, logits: torch.Tensor, delta: Tensors) -> torch.Tensor:  # noqa: ARG002
        """Cross-entropy against the ego-only scores, balanced between what is seen and the background."""
        wanted = torch.sigmoid(known.ego_logits)
        matters = torch.maximum(wanted, torch.sigmoid(known.benign_logits)) >= SEEN
        loss = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
        return loss[matters].mean().nan_to_num() + loss[~matters].mean().nan_to_num()
