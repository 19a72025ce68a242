"""Training of the embedded detector: seeded, resumable, on one CPU thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.detectors.network import MeanFusionNetwork
from robosac.detectors.voxels import AREA_M
from robosac.detectors.warp import sampling_matrix, warp
from robosac.files import replacing
from robosac.scenes.splits import TRAINING_SEEDS
from robosac.training.adversary import AdversaryConfig, add_adversary
from robosac.training.data import TrainingFrame, generate
from robosac.training.loss import detection_loss, stack, targets

Progress = Callable[[str, int, int, str], None]
"""Told the stage, the steps done, the steps in all, and a remark."""


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that decides what the training yields."""

    seed: int = 1
    """Of the initial weights and of every draw."""
    scenes: int = 800
    frames_per_scene: int = 5
    """Data: that many scenes from the start of the training seeds, frames 1 s apart."""
    steps: int = 2600
    frames_per_step: int = 4
    egos_per_frame: int = 3
    """Each step encodes all agents of some frames and decodes some of them as ego."""
    learning_rate: float = 3e-3
    weight_decay: float = 1e-2
    """AdamW; one cycle with cosine decay to zero."""
    ego_only_share: float = 0.2
    """Share of egos decoded alone; the others get a uniform number of teammates, at least one."""
    adversary: AdversaryConfig | None = None
    """Adversarial training, on top of weights that are trained already."""


def train_network(
    config: TrainingConfig,
    checkpoint: Path,
    progress: Progress,
    initial: Mapping[str, torch.Tensor] | None = None,
    checkpoint_every: int = 50,
) -> MeanFusionNetwork:
    """Train, or go on from ``checkpoint`` if it is there.

    Parameters
    ----------
    config : TrainingConfig
        Must be that of the checkpoint.
    checkpoint : Path
        Read first if it exists; written at the end, too.
    progress : callable
        Told after each step.
    initial : mapping of name to tensor, optional
        Weights to begin with; random ones by default.
    checkpoint_every : int
        Steps after which the checkpoint is written again.

    Returns
    -------
    MeanFusionNetwork
        In evaluation mode.

    Raises
    ------
    ValueError
        If the checkpoint was made with another configuration.
    """
    torch.manual_seed(config.seed)
    network = MeanFusionNetwork()
    if initial is not None:
        network.load_state_dict({name: tensor.float() for name, tensor in initial.items()})
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, config.learning_rate, total_steps=config.steps, pct_start=0.05
    )
    parts = {"network": network, "optimiser": optimiser, "schedule": schedule}
    done = _resume(checkpoint, config, parts)
    if done < config.steps:
        made, wanted = count(1), config.scenes * config.frames_per_scene
        seeds = TRAINING_SEEDS[: config.scenes]
        frames = generate(seeds, config.frames_per_scene, lambda: progress("generate", next(made), wanted, ""))
        for step in range(done, config.steps):
            loss = _step(network, optimiser, frames, config, np.random.default_rng([config.seed, step]))
            schedule.step()
            progress("train", step + 1, config.steps, f"loss {loss:.3f}")
            if (step + 1) % checkpoint_every == 0 or step + 1 == config.steps:
                _save(checkpoint, config, parts, step + 1)
    network.eval()
    return network


def _step(
    network: MeanFusionNetwork,
    optimiser: torch.optim.Optimizer,
    frames: list[TrainingFrame],
    config: TrainingConfig,
    rng: np.random.Generator,
) -> float:
    network.train()
    chosen = [frames[i] for i in rng.integers(0, len(frames), config.frames_per_step)]
    grids = torch.from_numpy(np.concatenate([frame.grids() for frame in chosen])).float()
    features = network.encode(grids.contiguous(memory_format=torch.channels_last))
    maps, goals, matrices, first = [], [], [], 0
    for frame in chosen:
        agents = len(frame.poses)
        for ego in rng.permutation(agents)[: config.egos_per_frame]:
            others = rng.permutation(np.delete(np.arange(agents), ego))
            selected = others[: 0 if rng.random() < config.ego_only_share else int(rng.integers(1, agents))]
            moves = [sampling_matrix(frame.poses[ego], frame.poses[j], AREA_M) for j in selected]
            maps.append(_fuse(features[first : first + agents], int(ego), selected, moves))
            matrices.append(moves)
            goals.append(targets(frame.near[ego], frame.hits[ego][np.append(selected, ego)].sum(axis=0)))
        first += agents
    fused, goal = torch.stack(maps), stack(goals)
    if config.adversary is not None:
        fused = add_adversary(network, fused, matrices, goal, config.adversary, rng)
    logits, codes = network.decode(fused)
    loss = detection_loss(logits, codes, goal)
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimiser.step()
    return float(loss.detach())


def _fuse(
    features: torch.Tensor, ego: int, selected: np.ndarray[Any, Any], moves: Sequence[FloatArray]
) -> torch.Tensor:
    own = features[ego : ego + 1]
    if not len(selected):
        return own[0]
    warped = warp(features[torch.from_numpy(selected)], torch.from_numpy(np.stack(moves)).float())
    return torch.cat([own, warped]).mean(dim=0)


def _save(checkpoint: Path, config: TrainingConfig, parts: dict[str, Any], step: int) -> None:
    state = {name: part.state_dict() for name, part in parts.items()}
    with replacing(checkpoint) as beside:
        torch.save({**state, "config": asdict(config), "step": step}, beside)


def _resume(checkpoint: Path, config: TrainingConfig, parts: dict[str, Any]) -> int:
    if not checkpoint.exists():
        return 0
    state = torch.load(checkpoint, weights_only=True)
    if state["config"] != asdict(config):
        ours = asdict(config)
        other = sorted(name for name in ours if state["config"].get(name) != ours[name])
        raise ValueError(
            f"{checkpoint} was made with another configuration ({', '.join(other)}); choose another folder or delete it"
        )
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return int(state["step"])
