"""The embedded detector: mean fusion of small BEV feature maps, with the weights that ship in the package."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch

from robosac.boxes import FloatArray, as_pose
from robosac.detectors.base import (
    DetectorInfo,
    Message,
    Precision,
    TensorSpec,
    calibration_beside,
    in_precision,
    witness_beside,
)
from robosac.detectors.decoding import boxes_there, cell_centres, decode_all, found_there
from robosac.detectors.device import CPU
from robosac.detectors.map_fusion import FEATURES, Decode, Heads, MapFusionDetector, Maps, combined
from robosac.detectors.network import CHANNELS, MAP, FastDecoder, MeanFusionNetwork, fold_batchnorm
from robosac.detectors.recorded import Recorded, Tensors
from robosac.detectors.voxels import AREA_M, occupancy
from robosac.detectors.weights_file import WeightsError, read_weights

SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "intersection-mean.safetensors"
ADVERSARIAL_WEIGHTS = SHIPPED_WEIGHTS.with_name("intersection-mean-adversarial.safetensors")
"""The same network after adversarial training against PGD, at the same feature gain: a baseline, not a defence to
serve.
"""


class EmbeddedDetector(MapFusionDetector):
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
        tensors, recipe = read_weights(weights)
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
        try:
            self._build(tensors, recipe, digest, weights)
        except RuntimeError as error:
            raise WeightsError(f"{weights} does not fit the network of {self.name}: {error}") from error

    @classmethod
    def from_network(
        cls, network: MeanFusionNetwork, gain: float, score_threshold: float, consensus_score: float
    ) -> EmbeddedDetector:
        """A detector around a network in memory, as training needs it; its digest is ``unsaved``."""
        detector = cls.__new__(cls)
        recipe = {"feature_gain": gain, "score_threshold": score_threshold, "consensus_score": consensus_score}
        detector._build(network.state_dict(), recipe, "unsaved", None)
        return detector

    def _build(
        self, tensors: Mapping[str, torch.Tensor], recipe: dict[str, Any], digest: str, weights: Path | None
    ) -> None:
        network = MeanFusionNetwork()
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        fold_batchnorm(network.eval().requires_grad_(False))
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._dtype, self._narrow = torch.float32, self._network
        self.place()
        self.recipe = recipe
        self.gain = _number(recipe, "feature_gain", np.inf)
        self._score_threshold = _number(recipe, "score_threshold", 1.0)
        layout = {FEATURES: TensorSpec("float16", (CHANNELS, MAP, MAP), ("int8",))}
        self.info = DetectorInfo(
            name=self.name,
            tensors={"ego": layout, "teammate": layout},
            area_m=(-AREA_M, -AREA_M, AREA_M, AREA_M),
            cell_m=2 * AREA_M / MAP,
            weights_digest=digest,
            consensus_score=_number(recipe, "consensus_score", 1.0),
            calibration=calibration_beside(weights) if weights else None,
            witness=witness_beside(weights) if weights else None,
        )

    def in_precision(self, precision: Precision) -> Self:
        """As `robosac.detectors.base.Precise.in_precision`; messages stay as they are."""
        other = copy(self)
        other.info = in_precision(self.info, precision)
        other._dtype = getattr(torch, precision)
        other._narrow = deepcopy(self._network).to(other._dtype)
        other.place()
        return other

    def place(self) -> None:
        """As `MapFusionDetector.place`."""
        super().place()
        self._placed = FastDecoder(self._narrow).to(self.device)
        self._found = Recorded(self._found_there)

    def encode(self, points: FloatArray, pose: FloatArray) -> Message:
        """As `robosac.detectors.base.Encoder.encode`; the z of the pose is the sensor's height above ground, metres."""
        pose = as_pose(pose)
        grid = torch.from_numpy(occupancy(points, float(pose[2, 3]))).float()
        with torch.inference_mode():
            features = (self._network.encode(grid[None])[0] * self.gain).contiguous()
        return Message(pose, {FEATURES: features.numpy().astype(np.float16)})

    def fused(self, maps: Maps) -> torch.Tensor:
        """The maps' mean."""
        return sum(maps[1:], maps[0]) / len(maps)

    def fused_of_each(self, maps: torch.Tensor, chosen: FloatArray) -> torch.Tensor:
        """As `MapFusionDetector.fused_of_each`."""
        return combined(maps, chosen / chosen.sum(axis=1, keepdims=True))

    def decoder(self, ego: Message, own: torch.Tensor) -> Decode:  # noqa: ARG002
        """Logits (64, 64) and codes (6, 64, 64)."""

        def decode(maps: Maps) -> Heads:
            logits, codes = self._narrow.decode(self.fused(maps)[None].to(self._dtype))
            return logits[0].float(), codes[0].float()

        return decode

    def context(self, ego: Message, own: torch.Tensor) -> None:
        """Nothing of a fusion is the ego's own."""

    def find(self, fused: torch.Tensor, contexts: Sequence[None]) -> list[FloatArray]:  # noqa: ARG002
        """Boxes as `decode_all` makes them."""
        if self.device == CPU:
            return decode_all(*self._heads(fused), self._score_threshold)
        return boxes_there(self._found(fused))

    def _heads(self, fused: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        logits, codes = self._placed.decode(fused.to(self._dtype))
        return logits.float(), codes.float()

    def _found_there(self, fused: torch.Tensor) -> Tensors:
        return found_there(*self._heads(fused), self._score_threshold)

    def places(self, codes: torch.Tensor) -> torch.Tensor:
        """Boxes (64, 64, 6) of all cells."""
        centres = torch.from_numpy(np.stack(cell_centres())).float()
        return torch.cat([codes[:2] + centres, codes[2:]]).permute(1, 2, 0)


def _number(recipe: Mapping[str, Any], name: str, most: float) -> float:
    value = recipe.get(name)
    if not isinstance(value, float) or not 0.0 < value < most:
        raise WeightsError(f"the recipe's {name} must be a number above 0 and below {most:g}, got {value!r}")
    return value
