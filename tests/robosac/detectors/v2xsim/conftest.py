from pathlib import Path

import numpy as np
import pytest
import torch

from robosac.boxes import pose_matrix
from robosac.detectors import Message, V2XSimDetector
from robosac.detectors.v2xsim import write_weights
from tests.conftest import GOLDEN
from tests.robosac.detectors.v2xsim.recipe import made_up, published_keys


@pytest.fixture(scope="session")
def published_state() -> dict[str, torch.Tensor]:
    """What a published checkpoint holds, made up."""
    return {f"module.{key}": made_up(key, shape) for key, shape, _ in published_keys()}


@pytest.fixture(scope="session")
def weights(published_state, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("v2xsim") / "made-up.safetensors"
    write_weights(published_state, "mean", path)
    return path


@pytest.fixture(scope="session")
def v2xsim(weights) -> V2XSimDetector:
    return V2XSimDetector(weights)


@pytest.fixture(scope="session")
def parity() -> dict[str, np.ndarray]:
    with np.load(GOLDEN / "model_parity.npz") as file:
        return dict(file)


@pytest.fixture(scope="session")
def team(v2xsim, parity) -> list[Message]:
    """The messages of the golden data's agents; agent 0's frame is the world's."""
    from robosac.detectors.v2xsim.voxels import from_indices

    return [
        v2xsim.encode_grid(from_indices(parity[f"voxel_indices_{k}"]), parity["trans_matrices"][0, k]) for k in range(6)
    ]


@pytest.fixture(scope="session")
def scans() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Random LiDAR returns and poses of four vehicles."""
    rng = np.random.default_rng(7)
    places = {"car-1": (0, 0, 0.1), "car-2": (9, 3, 1.7), "car-3": (-6, 8, 3.0), "car-4": (4, -7, -0.4)}
    return {
        name: (rng.uniform((-32, -32, -2.5), (32, 32, 1.5), (4000, 3)), pose_matrix(x, y, 1.8, yaw))
        for name, (x, y, yaw) in places.items()
    }
