"""Writing trained weights with the recipe that made them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from robosac.detectors.embedded import EmbeddedDetector
from robosac.detectors.network import MeanFusionNetwork
from robosac.detectors.weights_file import save_weights
from robosac.scenes.splits import TRAINING_SEEDS, VALIDATION_SEEDS
from robosac.training.loop import TrainingConfig
from robosac.training.validation import FRAMES_PER_SCENE, SCENES, OperatingPoint


def shipped_tensors(network: MeanFusionNetwork) -> dict[str, torch.Tensor]:
    """The network's tensors as they are shipped, floats rounded to float16."""
    return {
        name: tensor.half().contiguous() if tensor.is_floating_point() else tensor.contiguous()
        for name, tensor in network.state_dict().items()
    }


def export_weights(
    network: MeanFusionNetwork, config: TrainingConfig, point: OperatingPoint, command: str, path: Path
) -> dict[str, Any]:
    """Write a network as float16 safetensors.

    Parameters
    ----------
    command : str
        What a user types to make these weights again.

    Returns
    -------
    dict
        The recipe in the file's metadata: command, seed, data, operating point, validation figures, and the SHA-256 of
        the tensors.
    """
    recipe = {
        "detector": EmbeddedDetector.name,
        "command": command,
        "seed": config.seed,
        "training": asdict(config),
        "data": {
            "source": "robosac.scenes.IntersectionScene",
            "training_seeds": [TRAINING_SEEDS[0], TRAINING_SEEDS[config.scenes - 1]],
            "frames_per_scene": config.frames_per_scene,
            "validation_seeds": [VALIDATION_SEEDS[0], VALIDATION_SEEDS[SCENES - 1]],
            "validation_frames_per_scene": FRAMES_PER_SCENE,
        },
        "torch": torch.__version__,
        "feature_gain": point.feature_gain,
        "score_threshold": point.score_threshold,
        "consensus_score": point.consensus_score,
        "validation": point.figures,
    }
    return save_weights(shipped_tensors(network), recipe, path)
