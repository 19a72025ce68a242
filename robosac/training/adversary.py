"""Adversarial training: an attacker among the teammates while the detector learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.detectors.network import MeanFusionNetwork
from robosac.detectors.warp import warp
from robosac.training.loss import detection_loss


@dataclass(frozen=True)
class AdversaryConfig:
    """The adversary of the training (Madry et al., 2018; for collaborative perception Tu et al., 2021)."""

    share: float = 0.5
    """Share of the egos with teammates that meet an attacker."""
    epsilon: float = 0.5
    """L-infinity bound, in units of the features (those of the message without its gain)."""
    steps: int = 3
    """Signed steps of PGD from a random start."""
    step_size: float = 0.25
    """In units of the features."""


def add_adversary(
    network: MeanFusionNetwork,
    fused: torch.Tensor,
    matrices: Sequence[Sequence[FloatArray]],
    goal: tuple[torch.Tensor, ...],
    config: AdversaryConfig,
    rng: np.random.Generator,
) -> torch.Tensor:
    """Let the first teammate of some egos attack, so that the detection loss grows.

    The fusion is a mean, so a teammate's perturbation adds ``warp(delta) / (number of maps)`` to it, whatever the
    others send.

    Parameters
    ----------
    fused : (n, 64, 32, 32) tensor
        Benign fused maps.
    matrices : n sequences of (2, 3) ndarray
        `sampling_matrix` of each teammate of each ego.
    goal : four tensors
        `robosac.training.loss.targets`, stacked over n.

    Returns
    -------
    (n, 64, 32, 32) tensor
        Fused maps under attack; gradients flow to the benign ones.
    """
    attacked = [i for i, moves in enumerate(matrices) if len(moves) and rng.random() < config.share]
    if not attacked:
        return fused
    moves = torch.from_numpy(np.stack([matrices[i][0] for i in attacked])).float()
    weight = torch.tensor([1.0 / (1 + len(matrices[i])) for i in attacked])[:, None, None, None]
    index = torch.tensor(attacked)
    benign = fused[index].detach()
    aim = tuple(part[index] for part in goal)
    start = rng.uniform(-config.epsilon, config.epsilon, tuple(benign.shape)).astype(np.float32)
    delta = torch.from_numpy(start)
    network.eval()  # the attacker's passes must not move the statistics of the normalisation
    for _ in range(config.steps):
        delta.requires_grad_(True)
        loss = detection_loss(*network.decode(benign + weight * warp(delta, moves)), aim)
        (gradient,) = torch.autograd.grad(loss, delta)
        delta = (delta.detach() + config.step_size * gradient.sign()).clamp(-config.epsilon, config.epsilon)
    network.train()
    return fused.index_add(0, index, weight * warp(delta, moves))
