"""The network of the embedded detector: a small convolutional encoder and decoder around a mean of feature maps.

Nothing passes around the message (there is no skip connection), so the ego shares the same tensor as a teammate. All
convolutions of the decoder act on the fused map; the first one follows the mean directly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy

import torch
from torch import nn
from torch.nn import functional

from robosac.detectors.voxels import LAYERS

CHANNELS = 64
MAP = 32
HEAD = 64
BOX_CHANNELS = 6
"""Offset x, y (m), log length, log width, cos and sin of twice the yaw."""
AT_A_TIME = 16
"""Numbers of 32 bits that a processor works on at a time."""


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class MeanFusionNetwork(nn.Module):
    """Encoder 6 x 128 x 128 -> 64 x 32 x 32, decoder 64 x 32 x 32 -> (1 + 6) x 64 x 64; 0.2 M parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            nn.PixelUnshuffle(2), _block(LAYERS * 4, 48), _block(48, CHANNELS, stride=2), _block(CHANNELS, CHANNELS)
        )
        self.decoder = nn.Sequential(
            _block(CHANNELS, CHANNELS),
            _block(CHANNELS, CHANNELS),
            _block(CHANNELS, CHANNELS),
            nn.Conv2d(CHANNELS, 4 * 40, 1, bias=False),
            nn.PixelShuffle(2),
            nn.BatchNorm2d(40),
            nn.ReLU(inplace=True),
            _block(40, 40),
        )
        self.class_head = nn.Conv2d(40, 1, 1)
        self.box_head = nn.Conv2d(40, BOX_CHANNELS, 1)
        nn.init.constant_(self.class_head.bias, -math.log(99.0))  # type: ignore[arg-type]

    def encode(self, grids: torch.Tensor) -> torch.Tensor:
        """Occupancy (n, 6, 128, 128), float -> features (n, 64, 32, 32), not negative."""
        features: torch.Tensor = self.encoder(grids)
        return features

    def decode(self, fused: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Fused features (n, 64, 32, 32) -> class logits (n, 64, 64) and box codes (n, 6, 64, 64)."""
        shared = self.decoder(fused)
        return self.class_head(shared)[:, 0], self.box_head(shared)


class FastDecoder(nn.Module):
    """What `MeanFusionNetwork.decode` does, in less time; for inference only.

    The two heads are one convolution. Steps follow one another without any blocks. Outputs are filled up with zeros to
    multiples of `AT_A_TIME`: a processor makes 48 channels faster than 40.

    Parameters
    ----------
    network : MeanFusionNetwork
        Its batch norms folded.
    """

    def __init__(self, network: MeanFusionNetwork) -> None:
        super().__init__()
        *first, block = deepcopy(network.decoder).children()
        last = _filled_up([next(block.children())], 0)
        heads = _filled_up([network.class_head, network.box_head], last.out_channels)
        single = (step for step in nn.Sequential(*first).modules() if not list(step.children()))
        steps = [step for step in single if not isinstance(step, nn.Identity)]
        self.steps = nn.Sequential(*steps, last, nn.ReLU(inplace=True), heads)
        self.requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def decode(self, fused: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As `MeanFusionNetwork.decode`."""
        heads = fused
        for step in self.steps:
            heads = step.forward(heads)  # there are no hooks to look for
        return heads[:, 0].contiguous(), heads[:, 1 : 1 + BOX_CHANNELS]


def _filled_up(convolutions: Sequence[nn.Module], inputs: int) -> nn.Conv2d:
    """Convolutions of the same map as one, its outputs filled up; it may have more inputs than they."""
    weight, bias = (torch.cat([conv.get_parameter(name) for conv in convolutions]) for name in ("weight", "bias"))
    outputs, known, size, _ = weight.shape
    spare, more = max(0, inputs - known), -outputs % AT_A_TIME
    conv = nn.Conv2d(known + spare, outputs + more, size, padding=size // 2)
    conv.weight = nn.Parameter(functional.pad(weight, (0, 0, 0, 0, 0, spare, 0, more)))
    conv.bias = nn.Parameter(functional.pad(bias, (0, more)))
    return conv


def fold_batchnorm(module: nn.Module) -> nn.Module:
    """Merge every convolution with the batch norm that follows it; for inference only, in place.

    Between the two may be a pixel shuffle by n. It makes each of its channels of n^2 that follow each other.
    """
    for child in module.children():
        fold_batchnorm(child)
    if isinstance(module, nn.Sequential):
        for i in range(len(module) - 1):
            conv, following, at, times = module[i], module[i + 1], i + 1, 1
            if isinstance(following, nn.PixelShuffle):
                at, times = i + 2, following.upscale_factor**2
            norm = module[at] if at < len(module) else None
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[i] = torch.nn.utils.fuse_conv_bn_eval(conv.eval(), _repeated(norm.eval(), times))
                module[at] = nn.Identity()
    return module


def _repeated(norm: nn.BatchNorm2d, times: int) -> nn.BatchNorm2d:
    """A batch norm with every channel so many times in a row."""
    if times == 1:
        return norm
    wider = nn.BatchNorm2d(norm.num_features * times, norm.eps).eval()
    wider.load_state_dict(
        {name: value.repeat_interleave(times) if value.dim() else value for name, value in norm.state_dict().items()}
    )
    return wider
