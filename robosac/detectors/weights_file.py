"""Weights files: a detector's tensors as safetensors, with the recipe that made them in the metadata."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from robosac.files import replacing


class WeightsError(ValueError):
    """A weights file is missing, damaged or not one of this detector."""


def tensors_digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 over names, dtypes, shapes and bytes of tensors, in order of name; hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        array = tensors[name].contiguous().numpy()
        digest.update(f"{name}|{array.dtype}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def read_weights(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and recipe of a weights file.

    Raises
    ------
    WeightsError
        If the file cannot be read or its tensors do not have the digest that its metadata gives.
    """
    if Path(path).is_dir():
        raise WeightsError(f"{path} is a folder; a weights file is wanted")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except Exception as error:  # safetensors raises its own, undocumented types
        raise WeightsError(f"{path} is not a readable safetensors file: {error}") from error
    try:
        recipe: dict[str, Any] = json.loads(metadata["robosac"])
    except (KeyError, ValueError) as error:
        raise WeightsError(f"{path} carries no recipe in its metadata") from error
    if not isinstance(recipe, dict) or recipe.get("tensors_sha256") != tensors_digest(tensors):
        raise WeightsError(f"{path} is damaged: its tensors do not have the digest in its metadata")
    return tensors, recipe


def save_weights(tensors: dict[str, torch.Tensor], recipe: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Write a weights file, readable for everybody.

    Returns
    -------
    dict
        The recipe as it is in the file: with the digest of the tensors.
    """
    signed = {**recipe, "tensors_sha256": tensors_digest(tensors)}
    with replacing(path) as beside:
        save_file(tensors, beside, metadata={"robosac": json.dumps(signed)})
        beside.chmod(0o644)  # safetensors writes for the owner alone
    return signed
