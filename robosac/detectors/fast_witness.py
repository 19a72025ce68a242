"""The network of a witness with fewer operations.

It computes what `robosac.detectors.witness_network.WitnessNetwork` does, which stays the reference:

- What the network makes of where cells are is the same for all messages, but for a part that grows with the sensor's
  height.
- Its first weights are divided by the scale, and not the maps.
- The channels of a cell lie side by side in memory, as convolutions are fastest.
- Where the detector decodes in bfloat16, the convolutions between the first layer and the last do so too.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn import functional

from robosac.detectors.base import Message, Precision
from robosac.detectors.device import gone_up
from robosac.detectors.recorded import Recorded, Tensors
from robosac.detectors.witness_network import DILATIONS, WIDTH, Layout, WitnessNetwork, told
from robosac.testimony import LAYERS


class FastWitness:
    """The network of a witness, weights fixed.

    Parameters
    ----------
    network : WitnessNetwork
        On the device where messages are to be read.
    layout : Layout
    precision : str
    """

    def __init__(self, network: WitnessNetwork, layout: Layout, precision: Precision = "float32") -> None:
        self._layout = layout
        self._dtype = dtype = getattr(torch, precision)
        self._device = network.read.weight.device
        self._said = Recorded(self._say)
        with torch.no_grad():
            read = network.read.weight[:, :, 0, 0].T / layout.scale
            place: torch.Tensor = network.place(layout.geometry([0.0], self._device))
            ground = place[0].permute(1, 2, 0) + network.read.get_parameter("bias")
            self._place = (ground.flip(1) if layout.mirrored else ground).flatten()
            self._height = network.place.weight[:, -1, 0, 0].repeat(1, layout.height * layout.width)
            self._blocks = [
                (
                    block.get_parameter("weight").to(dtype, memory_format=torch.channels_last, copy=True),
                    block.get_parameter("bias").to(dtype, copy=True),
                    dilation,
                )
                for block, dilation in zip(network.blocks, DILATIONS, strict=True)
            ]
            self._head = network.head.get_parameter("bias")[:, None].clone(), network.head.weight[:, :, 0, 0].clone()
        with torch.inference_mode():  # where it is expanded
            self._read = read.clone(memory_format=torch.contiguous_format)

    def read(self, messages: Sequence[Message]) -> torch.Tensor:
        """Testimony (n, LAYERS, H, u, W, u): what `WitnessNetwork` gives, before the sides of a map are joined."""
        sent = gone_up([message.tensors[self._layout.tensor] for message in messages], self._device)
        return self._said(sent, told([float(message.pose[2, 3]) for message in messages], self._device))[0]

    def _say(self, sent: torch.Tensor, heights: torch.Tensor) -> Tensors:
        layout, u = self._layout, self._layout.upsampling
        sent = sent.float().flatten(2)
        hidden = torch.bmm(sent.mT, self._read.expand(len(sent), -1, -1)).flatten(1)
        hidden.add_(self._place).addmm_(heights[:, None], self._height).relu_()
        cells = hidden.view(-1, layout.height, layout.width, WIDTH)
        maps = (cells.flip(2) if layout.mirrored else cells).permute(0, 3, 1, 2).to(self._dtype)
        for weight, bias, dilation in self._blocks:
            maps = functional.conv2d(maps, weight, bias, 1, dilation, dilation).relu_().add_(maps)
        # all places of a layer side by side, as they are wanted
        said = torch.addmm(self._head[0], self._head[1], maps.permute(0, 2, 3, 1).flatten(0, 2).float().T)
        return (said.view(LAYERS, u, u, -1, layout.height, layout.width).permute(3, 0, 4, 1, 5, 2),)
