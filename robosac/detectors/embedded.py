"""The embedded detector: mean fusion of small BEV feature maps, with the weights that ship in the package."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors import safe_open

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message, TensorSpec, calibration_beside
from robosac.detectors.decoding import cell_centres, decode_boxes
from robosac.detectors.network import FEATURES, MAP, MeanFusionNetwork, fold_batchnorm
from robosac.detectors.voxels import AREA_M, occupancy
from robosac.detectors.warp import sampling_matrix, warp

SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "intersection-mean.safetensors"
ADVERSARIAL_WEIGHTS = SHIPPED_WEIGHTS.with_name("intersection-mean-adversarial.safetensors")
"""The same network after adversarial training against PGD, at the same feature gain: a baseline, not a defence to
serve.
"""
_TENSOR = "features"
_SPEC = TensorSpec("float16", (FEATURES, MAP, MAP))


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


def _number(recipe: Mapping[str, Any], name: str, most: float) -> float:
    value = recipe.get(name)
    if not isinstance(value, float) or not 0.0 < value < most:
        raise WeightsError(f"the recipe's {name} must be a number above 0 and below {most:g}, got {value!r}")
    return value


class EmbeddedDetector:
    """Mean fusion of 64 x 32 x 32 feature maps at 2 m a cell over +-32 m.

    A message holds one tensor, ``features``, float16, for ego and teammates alike: the encoder's output times the
    feature gain. The gain is undone before fusion, so it changes no answer; it fixes what a perturbation of a given
    size means.

    Parameters
    ----------
    weights : Path, optional
        Weights file; the shipped one by default.

    Raises
    ------
    WeightsError
        If the file is missing, damaged, or of another network.
    """

    name: ClassVar[str] = "intersection-mean"
    opens: ClassVar[tuple[str, ...]] = (name,)

    def __init__(self, weights: Path = SHIPPED_WEIGHTS) -> None:
        tensors, self.recipe = read_weights(weights)
        network = MeanFusionNetwork()
        try:
            network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        except RuntimeError as error:
            raise WeightsError(f"{weights} does not fit the network of {self.name}: {error}") from error
        self._configure(
            network,
            gain=_number(self.recipe, "feature_gain", np.inf),
            score_threshold=_number(self.recipe, "score_threshold", 1.0),
            consensus_score=_number(self.recipe, "consensus_score", 1.0),
            digest=hashlib.sha256(weights.read_bytes()).hexdigest(),
            calibration=calibration_beside(weights),
        )

    @classmethod
    def from_network(
        cls, network: MeanFusionNetwork, gain: float, score_threshold: float, consensus_score: float
    ) -> EmbeddedDetector:
        """A detector around a network in memory, as training needs it; its digest is ``unsaved``."""
        detector = cls.__new__(cls)
        detector.recipe = {}
        copy = MeanFusionNetwork()
        copy.load_state_dict(network.state_dict())
        detector._configure(copy, gain, score_threshold, consensus_score, "unsaved")
        return detector

    def _configure(
        self,
        network: MeanFusionNetwork,
        gain: float,
        score_threshold: float,
        consensus_score: float,
        digest: str,
        calibration: Path | None = None,
    ) -> None:
        self._network = network.eval().requires_grad_(False)
        fold_batchnorm(self._network)
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._gain = gain
        self._score_threshold = score_threshold
        specs = {_TENSOR: _SPEC}
        self._info = DetectorInfo(
            name=self.name,
            tensors={"ego": specs, "teammate": specs},
            area_m=(-AREA_M, -AREA_M, AREA_M, AREA_M),
            cell_m=2 * AREA_M / MAP,
            weights_digest=digest,
            consensus_score=consensus_score,
            calibration=calibration,
        )

    @property
    def info(self) -> DetectorInfo:
        """Name, message layout, area and digest."""
        return self._info

    def encode(self, points: FloatArray, pose: FloatArray) -> Message:
        """The message for a LiDAR scan.

        Parameters
        ----------
        points : (P, 3) ndarray
            Returns in the sensor's frame, metres.
        pose : (4, 4) ndarray
            world_from_sensor; its z is the sensor's height above ground.
        """
        grid = torch.from_numpy(occupancy(points, float(pose[2, 3]))).float()
        with torch.inference_mode():
            features = self._network.encode(grid[None])[0] * self._gain
        return Message(np.asarray(pose, dtype=np.float64), {_TENSOR: features.numpy().astype(np.float16)})

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedEmbedded:
        """Undo the gain and warp every teammate into the ego's frame, once."""
        with torch.inference_mode():
            features = self._received([ego, *teammates.values()]) / self._gain
            warped: Mapping[str, torch.Tensor] = {}
            if teammates:
                matrices = torch.stack([self._matrix(ego, message) for message in teammates.values()])
                warped = dict(zip(teammates, warp(features[1:], matrices), strict=True))
        return PreparedEmbedded(self._network, features[0], warped, self._score_threshold)

    def attack_surface(self, ego: Message, teammates: Mapping[str, Message]) -> EmbeddedAttackSurface:
        """The frame as a white-box attacker sees it. Perturbations act on the message, before gain and warp are
        undone.
        """
        own, *others = self._received([ego, *teammates.values()])
        matrices = {name: self._matrix(ego, message) for name, message in teammates.items()}
        messages = dict(zip(teammates, others, strict=True))
        return EmbeddedAttackSurface(self._network, self._gain, own / self._gain, messages, matrices)

    def perturbed(self, message: Message, tensor: torch.Tensor) -> Message:
        """The message with its features replaced by ``tensor`` (64, 32, 32), rounded to float16."""
        return Message(message.pose, {_TENSOR: tensor.detach().numpy().astype(np.float16)})

    @staticmethod
    def _received(messages: Sequence[Message]) -> torch.Tensor:
        """Features (n, 64, 32, 32) as sent; torch widens half floats several times faster than numpy."""
        return torch.from_numpy(np.stack([message.tensors[_TENSOR] for message in messages])).float()

    @staticmethod
    def _matrix(ego: Message, teammate: Message) -> torch.Tensor:
        return torch.from_numpy(sampling_matrix(ego.pose, teammate.pose, AREA_M)).float()


class PreparedEmbedded:
    """A frame of the embedded detector; see `robosac.detectors.base.PreparedFrame`."""

    def __init__(
        self,
        network: MeanFusionNetwork,
        own: torch.Tensor,
        warped: Mapping[str, torch.Tensor],
        score_threshold: float,
    ) -> None:
        self._network = network
        self._own = own
        self._warped = warped
        self._score_threshold = score_threshold

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of the ego fused with these teammates; with none, of the ego alone."""
        with torch.inference_mode():
            fused = _mean([self._own, *(self._warped[name] for name in teammates)])
            logits, codes = self._network.decode(fused[None])
            return decode_boxes(logits[0], codes[0], self._score_threshold)


class EmbeddedAttackSurface:
    """A frame of the embedded detector for an attacker; see `robosac.detectors.base.GeometricSurface`."""

    def __init__(
        self,
        network: MeanFusionNetwork,
        gain: float,
        own: torch.Tensor,
        messages: Mapping[str, torch.Tensor],
        matrices: Mapping[str, torch.Tensor],
    ) -> None:
        self._network = network
        self._gain = gain
        self._own = own
        self.messages = messages
        self._matrices = matrices
        self._benign = {name: self._warp(name, tensor) for name, tensor in messages.items()}

    def _warp(self, name: str, tensor: torch.Tensor) -> torch.Tensor:
        return warp(tensor[None] / self._gain, self._matrices[name][None])[0]

    def class_logits(self, messages: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Class logits (64, 64) of the ego fused with these messages; benign ones are not warped again."""
        return self._heads(messages)[0][0]

    def perceive(self, messages: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Class logits (64, 64) and the boxes (64, 64, 6) of all cells."""
        logits, codes = self._heads(messages)
        centres = torch.from_numpy(np.stack(cell_centres())).float()
        return logits[0], torch.cat([codes[0, :2] + centres, codes[0, 2:]]).permute(1, 2, 0)

    def _heads(self, messages: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        warped = [
            self._benign[name] if tensor is self.messages[name] else self._warp(name, tensor)
            for name, tensor in messages.items()
        ]
        return self._network.decode(_mean([self._own, *warped])[None])


def _mean(maps: list[torch.Tensor]) -> torch.Tensor:
    total = maps[0]
    for other in maps[1:]:
        total = total + other
    return total / len(maps)
