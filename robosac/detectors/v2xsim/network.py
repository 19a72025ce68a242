"""The V2X-Sim detection network: the half of the published network that an answer depends on, for inference.

A published checkpoint holds the same U-Net twice; detection uses the encoder of one (``u_encoder``) and the decoder of
the other (``decoder``), and two heads. `select_published` takes that half out of a checkpoint; `V2XSimNetwork` computes
with it, every batch norm folded into its convolution.

Levels of the encoder, channels x edge: x 32 x 256, x1 64 x 128, x2 128 x 64, x3 256 x 32 (the message), x4 512 x 16.
The decoder goes back up, doubling the edge (nearest) and joining the level of that size. The fused message enters at
the first join only; x, x1, x2 and x4 are the ego's own, whatever the hypothesis. As a convolution of joined maps is the
sum of their convolutions, all terms of the ego's own maps are computed once a frame (`V2XSimNetwork.context`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch.nn import functional

from robosac.detectors.weights_file import WeightsError

LAYERS = 13
GRID = 256
CHANNELS = 256
MAP = 32
ANCHORS = 6
"""A cell of the heads."""
CODE = 6
"""Numbers of a box code."""
_EPS = 1e-5
_NORM = ("weight", "bias", "running_mean", "running_var")


@dataclass(frozen=True)
class _Layer:
    """A convolution with batch norm and ReLU, or without both, by its published names."""

    conv: str
    norm: str | None
    inputs: int
    outputs: int
    kernel: tuple[int, ...] = (3, 3)
    stride: int = 1

    def shapes(self) -> dict[str, tuple[int, ...]]:
        shapes = {
            f"{self.conv}.weight": (self.outputs, self.inputs, *self.kernel),
            f"{self.conv}.bias": (self.outputs,),
        }
        if self.norm is not None:
            shapes |= {f"{self.norm}.{part}": (self.outputs,) for part in _NORM}
        return shapes


def _pair(side: str, level: str, inputs: int, outputs: int, stride: int = 1) -> tuple[_Layer, _Layer]:
    return (
        _Layer(f"{side}.conv{level}_1", f"{side}.bn{level}_1", inputs, outputs, stride=stride),
        _Layer(f"{side}.conv{level}_2", f"{side}.bn{level}_2", outputs, outputs),
    )


def _pointwise(level: int, channels: int) -> _Layer:
    name = f"u_encoder.conv3d_{level}"
    return _Layer(f"{name}.conv3d", f"{name}.bn3d", channels, channels, kernel=(1, 1, 1))


_ENCODER = (
    _pair("u_encoder", "_pre", LAYERS, 32),
    (*_pair("u_encoder", "1", 32, 64, stride=2), _pointwise(1, 64)),
    (*_pair("u_encoder", "2", 64, 128, stride=2), _pointwise(2, 128)),
    _pair("u_encoder", "3", 128, CHANNELS, stride=2),
)
_DEEPEST = _pair("u_encoder", "4", CHANNELS, 512, stride=2)
_BELOW = (512, 256, 128, 64)
"""Channels that come up from below into each join; they stand before those of the skip connection."""
_DECODER = (
    _pair("decoder", "5", 512 + 256, 256),
    _pair("decoder", "6", 256 + 128, 128),
    _pair("decoder", "7", 128 + 64, 64),
    _pair("decoder", "8", 64 + 32, 32),
)
_CLASSES = (
    _Layer("classification.conv1", "classification.bn1", 32, 32),
    _Layer("classification.conv2", None, 32, ANCHORS * 2, kernel=(1, 1)),
)
_CODES = (
    _Layer("regression.box_prediction.0", "regression.box_prediction.1", 32, 32),
    _Layer("regression.box_prediction.3", None, 32, ANCHORS * CODE, kernel=(1, 1)),
)
_ALL = (*(layer for level in (*_ENCODER, _DEEPEST, *_DECODER) for layer in level), *_CLASSES, *_CODES)


def published_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of a published checkpoint that are used, without the prefix ``module.``."""
    return {name: shape for layer in _ALL for name, shape in layer.shapes().items()}


def select_published(state: Mapping[str, object]) -> dict[str, torch.Tensor]:
    """The used half of a published checkpoint, as float32.

    Parameters
    ----------
    state : mapping of name to tensor
        The checkpoint's ``model_state_dict``; names may begin with ``module.``. What is not used is ignored.

    Raises
    ------
    WeightsError
        If a tensor is missing, has another shape, or holds NaN or infinity.
    """
    plain = {str(name).removeprefix("module."): value for name, value in state.items()}
    selected = {}
    expected = published_shapes()
    missing = [name for name in expected if name not in plain]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise WeightsError(f"not a V2X-Sim mean, max or sum fusion network: {', '.join(missing[:3])}{more} missing")
    for name, shape in expected.items():
        value = plain[name]
        if not isinstance(value, torch.Tensor):
            raise WeightsError(f"{name} must be a tensor, got {type(value).__name__}")
        if tuple(value.shape) != shape:
            raise WeightsError(f"{name} must have the shape {list(shape)}, got {list(value.shape)}")
        selected[name] = value.detach().float().contiguous()
        if not bool(torch.isfinite(selected[name]).all()):
            raise WeightsError(f"{name} holds NaN or infinity")
    return selected


@dataclass(frozen=True)
class Conv:
    """A convolution, batch norm folded in."""

    weight: torch.Tensor
    bias: torch.Tensor
    stride: int = 1

    @classmethod
    def folded(cls, layer: _Layer, tensors: Mapping[str, torch.Tensor]) -> Conv:
        weight, bias = tensors[f"{layer.conv}.weight"].double(), tensors[f"{layer.conv}.bias"].double()
        weight = weight.reshape(*weight.shape[:2], *layer.kernel[-2:])  # a 1 x 1 x 1 convolution acts on one layer
        if layer.norm is not None:
            scale, shift, mean, variance = (tensors[f"{layer.norm}.{part}"].double() for part in _NORM)
            factor = scale / torch.sqrt(variance + _EPS)
            weight, bias = weight * factor[:, None, None, None], (bias - mean) * factor + shift
        return cls(channels_last(weight.float()), bias.float(), layer.stride)

    def __call__(self, maps: torch.Tensor) -> torch.Tensor:
        padding = self.weight.shape[-1] // 2
        return functional.conv2d(maps, self.weight, self.bias, stride=self.stride, padding=padding)

    def to(self, dtype: torch.dtype, device: torch.device) -> Conv:
        """The same in other numbers, and on another device."""
        return Conv(channels_last(self.weight.to(device, dtype)), self.bias.to(device, dtype), self.stride)

    def split(self, channels: int) -> tuple[Conv, Conv]:
        """The parts that act on the first ``channels`` and on the others; their sum is the whole."""
        first, rest = self.weight[:, :channels], self.weight[:, channels:]
        return Conv(channels_last(first), torch.zeros_like(self.bias)), Conv(channels_last(rest), self.bias)


@dataclass(frozen=True)
class Join:
    """One step up of the decoder: the map from below, doubled, beside a skip connection; two convolutions."""

    below: Conv
    skip: Conv
    second: Conv

    def __call__(self, below_term: torch.Tensor, skip_term: torch.Tensor) -> torch.Tensor:
        return self.second((below_term + skip_term).relu_()).relu_()


class V2XSimNetwork:
    """The network, plainly computed and differentiable; float32, weights fixed.

    `robosac.detectors.v2xsim.fast` computes the same in less time, for inference.

    Parameters
    ----------
    tensors : mapping of published name to tensor
        As `select_published` returns them.
    """

    def __init__(self, tensors: Mapping[str, torch.Tensor]) -> None:
        def chain(layers: tuple[_Layer, ...]) -> tuple[Conv, ...]:
            return tuple(Conv.folded(layer, tensors) for layer in layers)

        self.encoder = tuple(chain(level) for level in _ENCODER)
        self.deepest_level = chain(_DEEPEST)
        self.joins = []
        for layers, below in zip(_DECODER, _BELOW, strict=True):
            first, second = chain(layers)
            self.joins.append(Join(*first.split(below), second))
        self.classes = chain(_CLASSES)
        self.codes = chain(_CODES)

    def levels(self, grids: torch.Tensor, count: int = 4) -> tuple[torch.Tensor, ...]:
        """Occupancy (n, 13, 256, 256), float -> the first of the levels x, x1, x2, x3; x3 is the message."""
        maps, levels = channels_last(grids), []
        for level in self.encoder[:count]:
            maps = _through(level, maps)
            levels.append(maps)
        return tuple(levels)

    def deepest(self, features: torch.Tensor) -> torch.Tensor:
        """x3 (n, 256, 32, 32) -> x4 (n, 512, 16, 16)."""
        return _through(self.deepest_level, features)

    def context(self, grid: torch.Tensor, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """What of the decoder no hypothesis changes: terms of first convolutions, before their ReLU.

        Parameters
        ----------
        grid, features : (1, 13, 256, 256), (1, 256, 32, 32) tensor
            The ego's occupancy and message.

        Returns
        -------
        (1, 256, 32, 32), (1, 128, 64, 64), (1, 64, 128, 128), (1, 32, 256, 256) tensor
            The terms of x4, x2, x1 and x.
        """
        x, x1, x2 = self.levels(grid, 3)
        first, *others = self.joins
        deepest = first.below(_doubled(self.deepest(channels_last(features))))
        return deepest, *(join.skip(level) for join, level in zip(others, (x2, x1, x), strict=True))

    def decode(self, fused: torch.Tensor, context: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Fused message -> logits and codes of every anchor.

        Parameters
        ----------
        fused : (1, 256, 32, 32) tensor
        context : tuple of tensors
            As `context` returns it.

        Returns
        -------
        logits : (393216, 2) tensor
            Background and vehicle. Anchor ``(row * 256 + column) * 6 + k``; rows along +y, columns along -x of the
            LiDAR.
        codes : (393216, 6) tensor
            See `robosac.detectors.v2xsim.anchors`.
        """
        first, *others = self.joins
        deepest, *skips = context
        maps = first(deepest, first.skip(channels_last(fused)))
        for join, skip_term in zip(others, skips, strict=True):
            maps = join(join.below(_doubled(maps)), skip_term)
        logits = self.classes[1](self.classes[0](maps).relu_())
        codes = self.codes[1](self.codes[0](maps).relu_())
        return _by_anchor(logits, 2), _by_anchor(codes, CODE)


def _through(convs: tuple[Conv, ...], maps: torch.Tensor) -> torch.Tensor:
    for conv in convs:
        maps = conv(maps).relu_()
    return maps


def _by_anchor(maps: torch.Tensor, numbers: int) -> torch.Tensor:
    return maps[0].permute(1, 2, 0).reshape(-1, numbers)


def _doubled(maps: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(maps, scale_factor=2, mode="nearest")


def channels_last(maps: torch.Tensor) -> torch.Tensor:
    """The same numbers in the order that convolutions are fastest on."""
    return maps.contiguous(memory_format=torch.channels_last)
