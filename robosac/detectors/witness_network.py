"""The network of a witness, and how it is shown the messages of its detector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from robosac.boxes import BoolArray, FloatArray
from robosac.detectors.base import DetectorInfo, Message
from robosac.detectors.device import CPU, gone_up, stacked
from robosac.detectors.weights_file import WeightsError
from robosac.testimony import LAYERS

PLACE_M = 1.0
"""Edge of the squares that testimony is about, as near as doubling cells of the message's map comes to it, metres."""
WIDTH = 32
DILATIONS = (1, 2, 4)
HIGHEST_M = 10.0
"""A sensor that is higher counts as this high."""
MAST_M = 20.0
USUAL_M = 1.7
"""A z below 0 or above the first is no height above ground, but above the sea, say. The sensor is then taken to be as
high as a car's: of a network that never saw such heights nothing can be believed.
"""
AROUND_M = 2.0
"""A message shows nothing of a place if it is the same in all cells so near, along x and y, or next to the place's."""
RIM = 16
"""The rim of a map is this part of its side."""
GEOMETRY = 7
"""Where a cell is, as the network is told: x, y and r (32 m), x / r, y / r, ln r / 3, and the sensor's height (5 m)."""


class WitnessNetwork(nn.Module):
    """A map (n, C, H, W) and geometry (n, 7, H, W) -> testimony (n, LAYERS, u H, u W); about 30 k parameters.

    Parameters
    ----------
    channels : int
        C.
    upsampling : int
        u.
    """

    def __init__(self, channels: int, upsampling: int) -> None:
        super().__init__()
        self.read = nn.Conv2d(channels, WIDTH, 1)
        self.place = nn.Conv2d(GEOMETRY, WIDTH, 1)
        self.blocks = nn.ModuleList(nn.Conv2d(WIDTH, WIDTH, 3, padding=d, dilation=d) for d in DILATIONS)
        self.head = nn.Conv2d(WIDTH, LAYERS * upsampling**2, 1)
        self.shuffle = nn.PixelShuffle(upsampling)

    def forward(self, maps: torch.Tensor, geometry: torch.Tensor) -> torch.Tensor:
        """As the class says."""
        hidden = torch.relu(self.read(maps) + self.place(geometry))
        for block in self.blocks:
            hidden = hidden + torch.relu(block(hidden))
        testimony: torch.Tensor = self.shuffle(self.head(hidden))
        return testimony


@dataclass(frozen=True)
class Layout:
    """Which tensor of a detector's messages is read, and how it lies."""

    tensor: str
    channels: int
    height: int
    width: int
    mirrored: bool
    """As `DetectorInfo` says."""
    scale: float
    """What its values are divided by, so that they are about 1."""
    half_extent_m: float

    @classmethod
    def of(cls, info: DetectorInfo, scale: float) -> Layout:
        """The largest floating-point map among the tensors that a teammate sends.

        Raises
        ------
        WeightsError
            If there is none, or the detector's area is not a square around the sensor.
        """
        maps = {
            name: spec
            for name, spec in info.tensors["teammate"].items()
            if len(spec.shape) == 3 and np.dtype(spec.dtype).kind == "f"
        }
        if not maps:
            raise WeightsError(f"{info.name} has no tensor (channels, rows, columns) of floats in its messages to read")
        west, south, east, north = info.area_m
        if not west == south == -east == -north:
            raise WeightsError(f"{info.name}: testimony needs an area that is a square around the sensor")
        tensor = max(maps, key=lambda name: maps[name].nbytes)
        channels, height, width = maps[tensor].shape
        return cls(tensor, channels, height, width, info.mirrored, scale, east)

    @property
    def upsampling(self) -> int:
        """Places in a row for each cell of the map."""
        cell_m = 2 * self.half_extent_m / self.height
        return 1 << max(0, round(math.log2(cell_m / PLACE_M)))

    def maps(self, messages: Sequence[Message], device: torch.device = CPU) -> torch.Tensor:
        """The maps (n, C, H, W) of messages, float32."""
        # one layout in memory, or rounding would differ between maps from an encoder, the wire and a file
        return self.scaled(stacked([message.tensors[self.tensor] for message in messages], device))

    def scaled(self, sent: torch.Tensor) -> torch.Tensor:
        """What the network reads of maps (n, C, H, W) as they are sent: columns along +x, values about 1."""
        return (sent.flip(-1) if self.mirrored else sent) / self.scale

    def empty(self, message: Message, places: FloatArray) -> BoolArray:
        """Whether a message is the same within `AROUND_M` of places (n, 2), its sender's frame, the rim of its map left
        out, where a network sees that it ends.
        """
        sent, cells = self.maps([message])[0].numpy(), np.array([self.width, self.height])
        cell_m = 2 * self.half_extent_m / cells
        reach = np.maximum(AROUND_M, cell_m)
        first, last = (places + self.half_extent_m - reach) / cell_m, (places + self.half_extent_m + reach) / cell_m
        around = np.clip(np.hstack([np.floor(first), np.ceil(last)]), [*cells // RIM] * 2, [*cells - cells // RIM] * 2)
        parts = [sent[:, y:below, x:right] for x, y, right, below in around.astype(int).tolist()]
        return np.array([bool((part == part[:, :1, :1]).all()) for part in parts], dtype=bool)

    def geometry(self, heights: Sequence[float], device: torch.device = CPU) -> torch.Tensor:
        """Where the cells of maps are whose sensors are so high, metres, as far as poses tell: (n, GEOMETRY, H, W)."""
        x, y = (
            (torch.arange(size, device=device) + 0.5) * (2 * self.half_extent_m / size) - self.half_extent_m
            for size in (self.width, self.height)
        )
        x, y = x.expand(self.height, -1), y[:, None].expand(-1, self.width)
        r = torch.hypot(x, y)
        fixed = torch.stack([x / 32, y / 32, r / 32, x / r, y / r, r.log() / 3])
        height = told(heights, device)[:, None, None, None]
        return torch.cat([fixed.expand(len(heights), -1, -1, -1), height.expand(-1, 1, self.height, self.width)], 1)


def told(heights: Sequence[float], device: torch.device = CPU) -> torch.Tensor:
    """How high sensors are, metres, as the network is told it: (n,)."""
    sure = [min(height, HIGHEST_M) if 0.0 <= height <= MAST_M else USUAL_M for height in heights]
    return gone_up([np.array(sure, dtype=np.float32)], device)[0] / 5
