"""The decoder of the V2X-Sim network with fewer multiply-adds, and in narrower numbers.

It computes what `robosac.detectors.v2xsim.network.V2XSimNetwork.decode` does, which stays the reference:

- A 3 x 3 convolution of a map that was doubled by its nearest neighbours is a 4 x 4 transposed convolution of the map
  itself, with stride 2 and padding 1: 16 multiply-adds for each place of the small map in the place of 36.
- Of the two class logits only the difference is needed.
- Box codes are computed only for anchors that become boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.nn import functional

from robosac.detectors.base import Precision
from robosac.detectors.device import CPU
from robosac.detectors.recorded import can_record
from robosac.detectors.v2xsim.network import ANCHORS, CODE, Conv, V2XSimNetwork, channels_last

Context = tuple[torch.Tensor, ...]
"""What of the decoder is an ego's own: maps (1, C, H, W)."""
_DOUBLED = torch.tensor([[0, 0, 1], [0, 1, 1], [1, 1, 0], [1, 0, 0]], dtype=torch.float64)
"""Which of three neighbouring weights each of four taps of the transposed convolution sums up."""


@dataclass(frozen=True)
class _Up:
    """A 3 x 3 convolution of a map, doubled; without bias."""

    weight: torch.Tensor

    @classmethod
    def of(cls, conv: Conv, dtype: torch.dtype, device: torch.device) -> _Up:
        weight = torch.einsum("tk,oikl,sl->iots", _DOUBLED, conv.weight.double(), _DOUBLED)
        return cls(channels_last(weight.to(device, dtype)))

    def __call__(self, maps: torch.Tensor) -> torch.Tensor:
        return functional.conv_transpose2d(maps, self.weight, stride=2, padding=1)


class FastDecoder:
    """The decoder of a network, weights fixed.

    Parameters
    ----------
    network : V2XSimNetwork
    precision : str
        What maps and weights are rounded to. Sums are made in float32.
    device : torch.device
        Where it computes, whereas the network is on the processor.
    """

    def __init__(self, network: V2XSimNetwork, precision: Precision = "float32", device: torch.device = CPU) -> None:
        self._dtype = dtype = getattr(torch, precision)
        self._encoder = tuple(tuple(conv.to(dtype, device) for conv in level) for level in network.encoder[:3])
        self._deepest = tuple(conv.to(dtype, device) for conv in network.deepest_level)
        self._ups = tuple(_Up.of(join.below, dtype, device) for join in network.joins)
        self._skips = tuple(join.skip.to(dtype, device) for join in network.joins)
        self._seconds = tuple(join.second.to(dtype, device) for join in network.joins)
        hidden, pairs = network.classes
        self._classes = hidden.to(dtype, device), _difference(pairs).to(dtype, device)
        hidden, codes = (conv.to(torch.float32, device) for conv in network.codes)
        self._codes_hidden = hidden.weight.permute(2, 3, 1, 0).reshape(-1, hidden.weight.shape[0]), hidden.bias
        self._codes = codes.weight[:, :, 0, 0].T, codes.bias

    def context(self, grid: torch.Tensor, features: torch.Tensor) -> Context:
        """What of the decoder no hypothesis changes, as `V2XSimNetwork.context` does."""
        maps, levels = channels_last(grid.to(self._dtype)), []
        for level in self._encoder:
            for conv in level:
                maps = _rectified(conv, maps)
            levels.append(maps)
        deepest = channels_last(features.to(self._dtype))
        for conv in self._deepest:
            deepest = _rectified(conv, deepest)
        skips = (skip(level) for skip, level in zip(self._skips[1:], reversed(levels), strict=True))
        return self._ups[0](deepest), *skips

    def decode(self, fused: torch.Tensor, context: Context) -> tuple[torch.Tensor, Codes]:
        """Fused message -> logits of every anchor, and the codes of those that one asks for.

        Parameters
        ----------
        fused : (n, 256, 32, 32) tensor
        context : tuple of tensors
            As `context` returns it; or `of_all` egos, in the order of their fused maps.

        Returns
        -------
        logits : (n, 393216) float32 tensor
            Of the vehicle, less that of the background; anchors as `V2XSimNetwork.decode` counts them.
        codes : Codes
        """
        deepest, *skips = context
        maps = self._join(0, deepest, self._skips[0](channels_last(fused.to(self._dtype))))
        for i, skip in enumerate(skips, 1):
            maps = self._join(i, self._ups[i](maps), skip)
        hidden, classes = self._classes
        logits = classes(_rectified(hidden, maps)).permute(0, 2, 3, 1).reshape(len(fused), -1).float()
        return logits, Codes(maps.permute(0, 2, 3, 1), self._codes_hidden, self._codes)

    def _join(self, i: int, below: torch.Tensor, skip: torch.Tensor) -> torch.Tensor:
        return _rectified(self._seconds[i], below.add_(skip).relu_() if i else (below + skip).relu_())


def _rectified(conv: Conv, maps: torch.Tensor) -> torch.Tensor:
    """What of a convolution is above zero; NVIDIA's accelerators find it in one go."""
    if not can_record(maps.device):
        return conv(maps).relu_()
    stride, padding = conv.stride, conv.weight.shape[-1] // 2
    return torch.cudnn_convolution_relu(maps, conv.weight, conv.bias, (stride,) * 2, (padding,) * 2, (1, 1), 1)


def of_all(contexts: Sequence[Context]) -> Context:
    """Contexts of fused maps in their order, as one; if all are the same, that."""
    first = contexts[0]
    if all(each is first for each in contexts):
        return first
    return tuple(channels_last(torch.cat(parts)) for parts in zip(*contexts, strict=True))


@dataclass(frozen=True)
class Codes:
    """Box codes, computed for the anchors that one asks for."""

    maps: torch.Tensor
    """(n, 256, 256, 32): the decoder's last."""
    hidden: tuple[torch.Tensor, torch.Tensor]
    """Weight (288, 32) and bias of the 3 x 3 convolution."""
    out: tuple[torch.Tensor, torch.Tensor]
    """Weight (32, 36) and bias of the 1 x 1 convolution."""

    def __getitem__(self, anchors: torch.Tensor) -> torch.Tensor:
        """Codes (k, 6), float32, of anchors (k,); those of the second map are counted on from those of the first."""
        cells, which = _distinct(anchors // ANCHORS)
        around = self._around(cells).float()
        hidden = torch.addmm(self.hidden[1], around, self.hidden[0]).relu_()
        codes = torch.addmm(self.out[1], hidden, self.out[0]).reshape(-1, ANCHORS, CODE)
        return codes[which, anchors % ANCHORS]

    def _around(self, cells: torch.Tensor) -> torch.Tensor:
        """What the 3 x 3 places around each cell hold (k, 288); beyond the map zero."""
        edge = self.maps.shape[1]
        steps = torch.arange(-1, 2, device=cells.device)
        which = cells // edge**2
        rows, columns = (cells // edge % edge)[:, None] + steps, (cells % edge)[:, None] + steps
        inside = ((rows >= 0) & (rows < edge))[:, :, None] & ((columns >= 0) & (columns < edge))[:, None]
        rows, columns = rows.clamp(0, edge - 1), columns.clamp(0, edge - 1)
        values = self.maps[which[:, None, None], rows[:, :, None], columns[:, None]]
        return (values * inside[..., None]).flatten(1)


def _distinct(cells: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each cell once, and which of them each is; on an accelerator all, as it would be waited for to count them."""
    if cells.device != CPU:
        return cells, torch.arange(len(cells), device=cells.device)
    distinct, which = torch.unique(cells, return_inverse=True)
    return distinct, which


def _difference(pairs: Conv) -> Conv:
    """Logits of background and vehicle by turns -> the vehicle's less the background's."""
    return Conv(channels_last(pairs.weight[1::2] - pairs.weight[::2]), pairs.bias[1::2] - pairs.bias[::2], pairs.stride)
