"""The V2X-Sim detector: fusion of 256 x 32 x 32 feature maps between the encoder and the decoder of a U-Net.

A teammate sends its feature map. The ego sends besides it its occupancy grid, from which the skip connections are
computed that lead around the message. Weights don't ship; ``robosac convert-checkpoint`` makes them from a published
checkpoint.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors.torch import save_file

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message, TensorSpec, calibration_beside
from robosac.detectors.embedded import WeightsError, read_weights, tensors_digest
from robosac.detectors.v2xsim.anchors import SCORE_THRESHOLD, detections, geometry
from robosac.detectors.v2xsim.fusions import FUSIONS, Fusion
from robosac.detectors.v2xsim.network import FEATURES, MAP, Context, V2XSimNetwork, select_published
from robosac.detectors.v2xsim.voxels import AREA_M, PACKED_SHAPE, BoolArray, occupancy, pack, unpack
from robosac.detectors.warp import sampling_matrix, warp

_FEATURES = "features"
_GRID = "grid"
_MIRROR = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, 1.0]])


def write_weights(state: Mapping[str, object], fusion: str, path: Path) -> dict[str, Any]:
    """Write the used half of a published checkpoint as float32 safetensors.

    Parameters
    ----------
    state : mapping of name to tensor
        See `select_published`.
    fusion : {"mean", "max", "sum"}
    path : Path

    Returns
    -------
    dict
        The recipe in the file's metadata.

    Raises
    ------
    WeightsError
        If the checkpoint is of another network.
    KeyError
        If there is no such fusion.
    """
    tensors = select_published(state)
    recipe = {
        "detector": name_of(fusion),
        "fusion": fusion,
        "command": f"robosac convert-checkpoint CHECKPOINT.pth OUT.safetensors --fusion {fusion}",
        "score_threshold": SCORE_THRESHOLD,
        "consensus_score": SCORE_THRESHOLD,
        "tensors_sha256": tensors_digest(tensors),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, metadata={"robosac": json.dumps(recipe)})
    return recipe


def name_of(fusion: str) -> str:
    """The name of the detector with a fusion; KeyError if there is no such fusion."""
    if fusion not in FUSIONS:
        raise KeyError(f"no fusion {fusion!r}; known: {', '.join(FUSIONS)}")
    return f"v2x-sim-{fusion}"


def mirrored_matrix(ego_pose: FloatArray, pose: FloatArray) -> FloatArray:
    """`sampling_matrix` (2, 3) for maps whose columns run along *minus* x."""
    matrix: FloatArray = sampling_matrix(ego_pose, pose, AREA_M) * _MIRROR
    return matrix


class V2XSimDetector:
    """Fusion of 256 x 32 x 32 feature maps at 2 m a cell over +-32 m; maps have rows along +y, columns along -x.

    Boxes are in the ego's LiDAR frame. The score threshold is 0.7 unless the recipe says otherwise, and all boxes take
    part in the consensus test.

    Parameters
    ----------
    weights : Path
        Weights file of `write_weights`.

    Raises
    ------
    WeightsError
        If the file is missing, damaged, or of another network.
    """

    opens: ClassVar[tuple[str, ...]] = tuple(map(name_of, FUSIONS))

    def __init__(self, weights: Path) -> None:
        tensors, self.recipe = read_weights(weights)
        fusion = self.recipe.get("fusion", "mean")
        if fusion not in FUSIONS or self.recipe.get("detector") != name_of(fusion):
            raise WeightsError(
                f"{weights} is for the detector {self.recipe.get('detector')!r} with the fusion {fusion!r}, not one of "
                f"{', '.join(self.opens)}"
            )
        try:
            self._network = V2XSimNetwork(select_published(tensors))
        except WeightsError as error:
            raise WeightsError(f"{weights}: {error}") from error
        self._fusion = FUSIONS[fusion]
        self._score_threshold = float(self.recipe.get("score_threshold", SCORE_THRESHOLD))
        features = TensorSpec("float32", (FEATURES, MAP, MAP))
        self._info = DetectorInfo(
            name=name_of(fusion),
            tensors={
                "ego": {_FEATURES: features, _GRID: TensorSpec("uint8", PACKED_SHAPE)},
                "teammate": {_FEATURES: features},
            },
            area_m=(-AREA_M, -AREA_M, AREA_M, AREA_M),
            cell_m=2 * AREA_M / MAP,
            weights_digest=hashlib.sha256(weights.read_bytes()).hexdigest(),
            consensus_score=float(self.recipe.get("consensus_score", SCORE_THRESHOLD)),
            calibration=calibration_beside(weights),
        )

    @property
    def info(self) -> DetectorInfo:
        """Name, message layout, area and digest."""
        return self._info

    def encode(self, points: FloatArray, pose: FloatArray) -> Message:
        """The message for a LiDAR scan, of an ego; `robosac.detectors.base.for_role` makes a teammate's of it.

        Parameters
        ----------
        points : (P, 3) ndarray
            Returns in the sensor's frame, metres; those 3 m below to 2 m above the sensor count.
        pose : (4, 4) ndarray
            world_from_sensor.
        """
        return self.encode_grid(occupancy(points), pose)

    def encode_grid(self, grid: BoolArray, pose: FloatArray) -> Message:
        """The message for an occupancy grid (256, 256, 13); see `robosac.detectors.v2xsim.voxels`."""
        with torch.inference_mode():
            features = self._network.levels(_as_maps(grid))[-1][0].contiguous()
        return Message(np.asarray(pose, dtype=np.float64), {_FEATURES: features.numpy(), _GRID: pack(grid)})

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedV2XSim:
        """Compute the ego's own part of the decoder and warp every teammate into the ego's frame, once."""
        with torch.inference_mode():
            own, context = self._own(ego)
            warped: Mapping[str, torch.Tensor] = {}
            if teammates:
                features = torch.stack([_features(message) for message in teammates.values()])
                matrices = torch.stack([_matrix(ego, message) for message in teammates.values()])
                warped = dict(zip(teammates, warp(features, matrices), strict=True))
        return PreparedV2XSim(self._network, self._fusion, context, own, warped, self._score_threshold)

    def attack_surface(self, ego: Message, teammates: Mapping[str, Message]) -> V2XSimAttackSurface:
        """The frame as a white-box attacker sees it. Perturbations act on the message, before the warp, as in the paper
        (the published code adds them after it).
        """
        with torch.no_grad():
            own, context = self._own(ego)
        messages = {name: _features(message) for name, message in teammates.items()}
        matrices = {name: _matrix(ego, message) for name, message in teammates.items()}
        return V2XSimAttackSurface(self._network, self._fusion, context, own, messages, matrices)

    def perturbed(self, message: Message, tensor: torch.Tensor) -> Message:
        """The message with its features replaced by ``tensor`` (256, 32, 32)."""
        return Message(message.pose, {**message.tensors, _FEATURES: tensor.detach().contiguous().numpy()})

    def _own(self, ego: Message) -> tuple[torch.Tensor, Context]:
        """The ego's features (256, 32, 32) and its part of the decoder."""
        own = _features(ego)
        return own, self._network.context(_as_maps(unpack(ego.tensors[_GRID])), own[None])


class PreparedV2XSim:
    """A frame of the V2X-Sim detector; see `robosac.detectors.base.PreparedFrame`."""

    def __init__(
        self,
        network: V2XSimNetwork,
        fusion: Fusion,
        context: Context,
        own: torch.Tensor,
        warped: Mapping[str, torch.Tensor],
        score_threshold: float,
    ) -> None:
        self._network = network
        self._fusion = fusion
        self._context = context
        self._own = own
        self._warped = warped
        self._score_threshold = score_threshold

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of the ego fused with these teammates; with none, of the ego alone."""
        with torch.inference_mode():
            fused = self._fusion([self._own, *(self._warped[name] for name in teammates)])
            boxes, _ = detections(*self._network.decode(fused[None], self._context), self._score_threshold)
        return boxes


class V2XSimAttackSurface:
    """A frame of the V2X-Sim detector for an attacker; see `robosac.detectors.base.GeometricSurface`."""

    def __init__(
        self,
        network: V2XSimNetwork,
        fusion: Fusion,
        context: Context,
        own: torch.Tensor,
        messages: Mapping[str, torch.Tensor],
        matrices: Mapping[str, torch.Tensor],
    ) -> None:
        self._network = network
        self._fusion = fusion
        self._context = context
        self._own = own
        self.messages = messages
        self._matrices = matrices
        self._benign = {name: self._warp(name, tensor) for name, tensor in messages.items()}

    def _warp(self, name: str, tensor: torch.Tensor) -> torch.Tensor:
        return warp(tensor[None], self._matrices[name][None])[0]

    def class_logits(self, messages: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Logits (393216,) of every anchor's score, of the ego fused with these messages; benign ones are not warped
        again.
        """
        logits, _ = self._heads(messages)
        return logits[:, 1] - logits[:, 0]

    def perceive(self, messages: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Class logits (393216,) and the boxes (393216, 6) of all anchors."""
        logits, codes = self._heads(messages)
        return logits[:, 1] - logits[:, 0], geometry(codes)

    def _heads(self, messages: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        warped = [
            self._benign[name] if tensor is self.messages[name] else self._warp(name, tensor)
            for name, tensor in messages.items()
        ]
        return self._network.decode(self._fusion([self._own, *warped])[None], self._context)


def _features(message: Message) -> torch.Tensor:
    """A message's feature map (256, 32, 32), copied: the array may be read-only."""
    return torch.from_numpy(np.array(message.tensors[_FEATURES], dtype=np.float32))


def _as_maps(grid: BoolArray) -> torch.Tensor:
    """A grid (256, 256, 13) as the network takes it (1, 13, 256, 256)."""
    return torch.from_numpy(grid.transpose(2, 0, 1)[None].astype(np.float32))


def _matrix(ego: Message, teammate: Message) -> torch.Tensor:
    return torch.from_numpy(mirrored_matrix(ego.pose, teammate.pose)).float()
