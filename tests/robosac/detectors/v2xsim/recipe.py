"""The made-up weights of the golden data: every value a hash of its tensor's name and its place."""

import ast
import zlib
from collections.abc import Iterator

import numpy as np
import torch

from tests.conftest import GOLDEN

MASK = np.uint64(0xFFFFFFFF)


def noise(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Values in [0, 1), the same everywhere."""

    def mixed(h: np.ndarray, shift: int, factor: int) -> np.ndarray:
        return ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & MASK

    start = (zlib.crc32(key.encode()) * 0x85EBCA6B + 0x165667B1) & 0xFFFFFFFF
    h = (np.arange(int(np.prod(shape)), dtype=np.uint64) * np.uint64(0x9E3779B1) + np.uint64(start)) & MASK
    h = mixed(mixed(h, 16, 0x7FEB352D), 15, 0x846CA68B)
    return ((h ^ (h >> np.uint64(16))) / 2.0**32).reshape(shape)


def made_up(key: str, shape: tuple[int, ...]) -> torch.Tensor:
    if key.endswith("num_batches_tracked"):
        return torch.tensor(0)
    u = noise(key, shape)
    if key.endswith("running_mean"):
        u = (2 * u - 1) * 0.2
    elif key.endswith("running_var"):
        u = 0.5 + u
    elif len(shape) >= 4:
        u = (2 * u - 1) * np.sqrt(6 / np.prod(shape[1:]))
    elif key.endswith("bias"):
        u = (2 * u - 1) * 0.1
    else:
        u = 0.8 + 0.4 * u
    return torch.from_numpy(np.asarray(u, dtype=np.float32))


def published_keys() -> Iterator[tuple[str, tuple[int, ...], bool]]:
    """Name, shape and whether it is used, of every tensor of a published checkpoint."""
    for line in (GOLDEN / "state_dict_keys.txt").read_text().splitlines():
        if not line.startswith("#"):
            _, key, shape, _, used = line.split("\t")
            yield key, ast.literal_eval(shape), used == "yes"
