"""The V2X-Sim detector: fusion of 256 x 32 x 32 feature maps between the encoder and the decoder of a U-Net.

A teammate sends its feature map. The ego sends besides it its occupancy grid, from which the skip connections are
computed that lead around the message. Weights don't ship; ``robosac convert-checkpoint`` makes them from a published
checkpoint.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any, ClassVar, Self

import torch

from robosac.boxes import BoolArray, FloatArray, as_pose
from robosac.detectors.base import (
    DetectorInfo,
    Message,
    Precision,
    TensorSpec,
    calibration_beside,
    in_precision,
    witness_beside,
)
from robosac.detectors.device import CPU, gone_up, stacked
from robosac.detectors.map_fusion import FEATURES, Decode, Heads, MapFusionDetector, Maps, combined
from robosac.detectors.recorded import Recorded, Tensors, copies
from robosac.detectors.v2xsim.anchors import (
    SCORE_THRESHOLD,
    detections_of_each,
    detections_there,
    found_there,
    geometry,
)
from robosac.detectors.v2xsim.fast import Context, FastDecoder, of_all
from robosac.detectors.v2xsim.network import CHANNELS, MAP, V2XSimNetwork, select_published
from robosac.detectors.v2xsim.voxels import AREA_M, PACKED_SHAPE, occupancy, pack, unpack
from robosac.detectors.weights_file import WeightsError, read_weights, save_weights

FUSIONS: Mapping[str, Callable[..., torch.Tensor]] = {"mean": torch.mean, "max": torch.amax, "sum": torch.sum}
"""How warped maps (n, C, H, W) become one (C, H, W); places that a teammate does not see are zero."""
NAMES = {fusion: f"v2x-sim-{fusion}" for fusion in FUSIONS}
"""The detectors of this family, by fusion."""
_GRID = "grid"


def write_weights(state: Mapping[str, object], fusion: str, path: Path) -> dict[str, Any]:
    """Write the used half of a published checkpoint as float32 safetensors.

    Parameters
    ----------
    state : mapping of name to tensor
        See `select_published`.
    fusion : str
        One of `NAMES`.
    path : Path
        The file to write.

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
    recipe = {
        "detector": NAMES[fusion],
        "fusion": fusion,
        "command": f"robosac convert-checkpoint CHECKPOINT.pth OUT.safetensors --fusion {fusion}",
        "score_threshold": SCORE_THRESHOLD,
        "consensus_score": SCORE_THRESHOLD,
    }
    return save_weights(select_published(state), recipe, path)


class V2XSimDetector(MapFusionDetector):
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

    opens: ClassVar[tuple[str, ...]] = tuple(NAMES.values())
    mirrored: ClassVar[bool] = True

    def __init__(self, weights: Path) -> None:
        tensors, self.recipe = read_weights(weights)
        fusion = self.recipe.get("fusion", "mean")
        if fusion not in FUSIONS or self.recipe.get("detector") != NAMES[fusion]:
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
        features = TensorSpec("float32", (CHANNELS, MAP, MAP), ("float16", "int8"))
        self.info = DetectorInfo(
            name=NAMES[fusion],
            tensors={
                "ego": {FEATURES: features, _GRID: TensorSpec("uint8", PACKED_SHAPE)},
                "teammate": {FEATURES: features},
            },
            area_m=(-AREA_M, -AREA_M, AREA_M, AREA_M),
            cell_m=2 * AREA_M / MAP,
            weights_digest=hashlib.sha256(weights.read_bytes()).hexdigest(),
            consensus_score=float(self.recipe.get("consensus_score", SCORE_THRESHOLD)),
            calibration=calibration_beside(weights),
            witness=witness_beside(weights),
            mirrored=self.mirrored,
        )
        self.place()

    def in_precision(self, precision: Precision) -> Self:
        """As `robosac.detectors.base.Precise.in_precision`; messages stay float32."""
        other = copy(self)
        other.info = in_precision(self.info, precision)
        other.place()
        return other

    def place(self) -> None:
        """As `MapFusionDetector.place`."""
        super().place()
        self._fast = FastDecoder(self._network, self.info.precision, self.device)
        self._begun, self._found = Recorded(self._begun_there), Recorded(self._found_there)

    def encode(self, points: FloatArray, pose: FloatArray) -> Message:
        """As `robosac.detectors.base.Encoder.encode`; returns from 3 m below to 2 m above the sensor count."""
        return self.encode_grid(occupancy(points), pose)

    def encode_grid(self, grid: BoolArray, pose: FloatArray) -> Message:
        """The message for an occupancy grid (256, 256, 13); see `robosac.detectors.v2xsim.voxels`."""
        with torch.inference_mode():
            features = self._network.levels(_as_maps(grid))[-1][0].contiguous()
        return Message(as_pose(pose), {FEATURES: features.numpy(), _GRID: pack(grid)})

    def fused(self, maps: Maps) -> torch.Tensor:
        """By the recipe's fusion."""
        if maps[0].is_contiguous():
            return self._fusion(torch.stack(list(maps)), dim=0)
        cells = torch.stack([each.permute(1, 2, 0) for each in maps])  # as they lie, or it takes ten times as long
        return self._fusion(cells, dim=0).permute(2, 0, 1)

    def fused_of_each(self, maps: torch.Tensor, chosen: FloatArray) -> torch.Tensor:
        """As `MapFusionDetector.fused_of_each`."""
        if self._fusion is FUSIONS["max"]:
            return super().fused_of_each(maps, chosen)
        return combined(maps, chosen / chosen.sum(axis=1, keepdims=True) if self._fusion is FUSIONS["mean"] else chosen)

    def decoder(self, ego: Message, own: torch.Tensor) -> Decode:
        """Logits (393216,) and codes (393216, 6) of all anchors; the decoder's part that is the ego's own, once."""
        context = self._network.context(_unpacked(gone_up([ego.tensors[_GRID]])), own[None])

        def decode(maps: Maps) -> Heads:
            logits, codes = self._network.decode(self.fused(maps)[None], context)
            return logits[:, 1] - logits[:, 0], codes

        return decode

    def context(self, ego: Message, own: torch.Tensor) -> Context:
        """The decoder's part that is the ego's own."""
        packed = gone_up([ego.tensors[_GRID]], self.device)
        if self.device == CPU:
            return self._begun_there(packed, own[None])
        return copies(self._begun(packed, own[None]))

    def _begun_there(self, packed: torch.Tensor, own: torch.Tensor) -> Context:
        return self._fast.context(_unpacked(packed), own)

    def find(self, fused: torch.Tensor, contexts: Sequence[Context]) -> list[FloatArray]:
        """Boxes by the fast decoder, in this detector's precision."""
        context = of_all(contexts)
        if self.device == CPU:
            found = detections_of_each(*self._fast.decode(fused, context), self._score_threshold)
            return [boxes for boxes, _ in found]
        return detections_there(self._found(fused, *context))

    def _found_there(self, fused: torch.Tensor, *context: torch.Tensor) -> Tensors:
        return found_there(*self._fast.decode(fused, context), self._score_threshold)

    def places(self, codes: torch.Tensor) -> torch.Tensor:
        """Boxes (393216, 6) of all anchors."""
        return geometry(codes)


def _unpacked(packed: torch.Tensor) -> torch.Tensor:
    """Grids packed as bits (n, 256, 416), as the network takes them (n, 13, 256, 256)."""
    return unpack(packed).permute(0, 3, 1, 2).float()


def _as_maps(grid: BoolArray) -> torch.Tensor:
    """A grid (256, 256, 13) as the network takes it (1, 13, 256, 256)."""
    return stacked([grid]).permute(0, 3, 1, 2)
