"""A small network that reads one agent's message alone, and says for every place what is there.

It belongs to a detector's weights, but is no part of the detector: it decodes no fusion. What it says of a message
depends on that message only, so no other agent can change it. `robosac.calibration.witness` trains it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from robosac.boxes import BoolArray, FloatArray
from robosac.detectors.base import DetectorInfo, Message
from robosac.detectors.device import CPU, as_device, stacked
from robosac.detectors.warp import warp
from robosac.detectors.weights_file import WeightsError, read_weights, save_weights
from robosac.steps import Steps, finished
from robosac.testimony import LAYERS, LIKELIHOOD, Testimony, planar

Float16Array = np.ndarray[Any, np.dtype[np.float16]]
PLACE_M = 1.0
"""Edge of the squares that testimony is about, as near as doubling cells of the message's map comes to it, metres."""
WIDTH = 32
DILATIONS = (1, 2, 4)
LARGEST = 50.0
"""Whatever a message holds, nothing is read from it that is farther from 0: half floats would become infinite, and what
is laid over the ego's map no number.
"""
HIGHEST_M = 10.0
"""A sensor that is higher counts as this high."""
MAST_M = 20.0
USUAL_M = 1.7
"""A z below 0 or above the first is no height above ground, but above the sea, say. The sensor is then taken to be as
high as a car's: of a network that never saw such heights nothing can be believed.
"""
AT_ONCE = 8
"""Messages read together: between groups it is looked at whether there is time for another one."""
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
        told = [min(height, HIGHEST_M) if 0.0 <= height <= MAST_M else USUAL_M for height in heights]
        height = torch.tensor(told, dtype=torch.float32).to(device)[:, None, None, None] / 5
        return torch.cat([fixed.expand(len(heights), -1, -1, -1), height.expand(-1, 1, self.height, self.width)], 1)


class Witness:
    """A trained network, and how the messages of its detector are read.

    Parameters
    ----------
    network : WitnessNetwork
        On the device where messages are to be read.
    layout : Layout
    """

    def __init__(self, network: WitnessNetwork, layout: Layout) -> None:
        self.network = network.eval().requires_grad_(False)
        self.layout = layout
        self._device = next(network.parameters()).device

    def testify(
        self,
        ego: str,
        messages: dict[str, Message],
        first: Collection[str] = (),
        fits: Callable[[Collection[str]], bool] = lambda _: True,
    ) -> Testimony:
        """What each message says by itself.

        Parameters
        ----------
        ego : str
            Whose frame places are asked in; among the messages.
        messages : dict of agent to Message
            `AT_ONCE` of them are read together, the ego's in the first group.
        first : collection of str
            Agents whose messages are read before those of others.
        fits : callable, optional
            Whether there is time to read the messages of some agents (`Deadline.reading`). Once there is not, the
            others say nothing (``Testimony.unread``).
        """
        return finished(self.testify_in_steps(ego, messages, first, fits))

    def testify_in_steps(
        self,
        ego: str,
        messages: dict[str, Message],
        first: Collection[str] = (),
        fits: Callable[[Collection[str]], bool] = lambda _: True,
        known: Mapping[str, Float16Array] | None = None,
    ) -> Steps[Testimony]:
        """As `testify`, with a pause before each group but the first. Messages of which it is ``known`` what they say
        are not read.
        """
        names, known = list(messages), known or {}
        order = sorted(range(len(names)), key=lambda i: (names[i] != ego, names[i] not in first))
        size = self.layout.height * self.layout.upsampling, self.layout.width * self.layout.upsampling
        maps, count = np.zeros((len(names), LAYERS, *size), dtype=np.float16), 0
        while count < len(names):
            group = sorted(order[count : count + AT_ONCE])
            if unknown := [i for i in group if names[i] not in known]:
                if count:
                    yield
                if not fits([names[i] for i in group]):
                    break
                maps[unknown] = self._read([messages[names[i]] for i in unknown])
            for i in group:
                if names[i] in known:
                    maps[i] = known[names[i]]
            count += len(group)
        from_ego = planar(messages[ego].pose, [message.pose for message in messages.values()])
        said = as_testimony(tuple(names), maps, from_ego, self.layout.half_extent_m)
        unread = tuple(names[i] for i in sorted(order[count:]))
        return replace(said, unread=unread, empty=lambda agent, places: self.layout.empty(messages[agent], places))

    def read_message(self, message: Message) -> Float16Array:
        """What a message says by itself: (LAYERS, H, W), as `Testimony` has it."""
        maps: Float16Array = self._read([message])[0]
        return maps

    def _read(self, messages: Sequence[Message]) -> Float16Array:
        """What some messages say: (n, LAYERS, H, W)."""
        with torch.inference_mode():
            sent = self.layout.maps(messages, self._device)
            read = self.read(sent, [float(message.pose[2, 3]) for message in messages])
            maps: Float16Array = torch.nan_to_num(read).clamp(-LARGEST, LARGEST).half().cpu().numpy()
        return maps

    def read(self, maps: torch.Tensor, heights: Sequence[float]) -> torch.Tensor:
        """Testimony (n, LAYERS, H, W) of maps as `Layout.scaled` gives them; differentiable.

        ``heights`` are those of the sensors above ground, metres.
        """
        testimony: torch.Tensor = self.network(maps, self.layout.geometry(heights, maps.device))
        return testimony

    def write(self, path: Path, info: DetectorInfo, recipe: dict[str, Any]) -> None:
        """Write as float16 safetensors, with the digest of the detector's weights."""
        tensors = {name: tensor.half().contiguous() for name, tensor in self.network.state_dict().items()}
        kept = {
            "witness_of": info.name,
            "weights_digest": info.weights_digest,
            "scale": self.layout.scale,
            "recipe": recipe,
        }
        save_weights(tensors, kept, path)

    @classmethod
    def open(cls, path: Path, info: DetectorInfo) -> Witness:
        """Read what `write` wrote for this detector, to its device.

        Raises
        ------
        WeightsError
            If the file is damaged, or belongs to other weights.
        """
        tensors, kept = read_weights(path)
        if kept.get("weights_digest") != info.weights_digest:
            raise WeightsError(
                f"{path.name} belongs to weights with the digest {kept.get('weights_digest')!s:.12}..., not to "
                f"{info.name} with {info.weights_digest:.12}...: calibrate again"
            )
        layout = Layout.of(info, float(kept["scale"]))
        network = WitnessNetwork(layout.channels, layout.upsampling)
        try:
            network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        except RuntimeError as error:
            raise WeightsError(f"{path} does not fit the messages of {info.name}: {error}") from error
        return cls(network.to(as_device(info.device)), layout)


def as_testimony(agents: tuple[str, ...], maps: Float16Array, from_ego: FloatArray, half_extent_m: float) -> Testimony:
    """Testimony of maps (agents, LAYERS, H, W), laid over the ego's; as `Testimony` has them, but float16."""
    moves = from_ego[:, :2].copy()
    moves[:, :, 2] /= half_extent_m
    with torch.inference_mode():
        likelihood = torch.from_numpy(maps[:, LIKELIHOOD, None]).float()
        over_ego = warp(likelihood, torch.from_numpy(moves).float())[:, 0].numpy()
    return Testimony(agents, maps.astype(np.float32), from_ego, over_ego, half_extent_m)
