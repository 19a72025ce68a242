"""What detectors have in common whose messages hold one feature map.

Every teammate's map is laid over the ego's. The maps of a subset are fused into one, and that is decoded. Such a
detector is a subclass of `MapFusionDetector`, which says how its maps are fused and decoded.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import islice
from typing import Any, ClassVar, Self

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message
from robosac.detectors.device import CPU, as_device, by_cell, gone_up, on_device, stacked
from robosac.detectors.recorded import Recorded, Tensors
from robosac.detectors.warp import corners, gathered, sampling_matrices, warp
from robosac.testimony import planar

FEATURES = "features"
"""The tensor of a message that holds its map."""
WORTH = 8
"""Subsets that an accelerator decodes at once, unless told otherwise: the ego alone, and seven hypotheses."""
AT_ONCE = 8
"""Maps warped together: what more of them take in between no longer fits into caches."""
PARTS = 8
"""Parts of a map's channels that an accelerator warps at a time: cells alone would not keep it busy."""
Tensor = np.ndarray[Any, np.dtype[Any]]
Maps = Sequence[torch.Tensor]
Heads = tuple[torch.Tensor, torch.Tensor]
"""The class logit of each place where there might be a vehicle, and the codes of all boxes."""
Decode = Callable[[Maps], Heads]
"""From maps to fuse, the ego's first and all in its frame."""
Subsets = Sequence[Collection[str]]


class MapFusionDetector(ABC):
    """A detector (`robosac.detectors.base.Detector`) but for its network and `encode`.

    Maps (C, H, W) have rows along +y. In a prepared frame the channels of a cell lie side by side in memory. What an
    attacker perturbs is the map in the message, before it is warped.
    """

    info: DetectorInfo
    mirrored: ClassVar[bool] = False
    """Whether columns of the maps run along minus x."""
    device: torch.device = CPU
    """Where frames are prepared and decoded."""
    worth: int = 1
    """As `robosac.detectors.base.Batching.worth` of its frames."""
    gain: float = 1.0
    """What is fused are the maps that are sent, divided by this."""

    @abstractmethod
    def fused(self, maps: Maps) -> torch.Tensor:
        """Maps (C, H, W), all in the ego's frame and the ego's first, as one."""

    def fused_of_each(self, maps: torch.Tensor, chosen: FloatArray) -> torch.Tensor:
        """As `fused`, (n, C, H, W), of those maps (m, C, H, W) that are 1 in each row of ``chosen`` (n, m), float32.

        By default they are fused one after the other. Where `fused` is linear, `combined` does all at once.
        """
        return torch.stack([self.fused([maps[i] for i in np.flatnonzero(row).tolist()]) for row in chosen])

    @abstractmethod
    def decoder(self, ego: Message, own: torch.Tensor) -> Decode:
        """Do once what all fusions of a frame share. ``own`` (C, H, W) is the ego's map.

        It is for attackers: differentiable, and on the processor.
        """

    @abstractmethod
    def context(self, ego: Message, own: torch.Tensor) -> Any:
        """As `decoder`, but what `find` wants of it. ``own`` is on the detector's device."""

    @abstractmethod
    def find(self, fused: torch.Tensor, contexts: Sequence[Any]) -> list[FloatArray]:
        """Boxes, as `robosac.detectors.base.PreparedFrame.detect` gives them, of each of some fused maps (n, C, H, W).

        ``contexts`` are those of their frames, n of them. It is on the detector's device, and without gradients.
        """

    def place(self) -> None:
        """Put what `laid`, `context` and `find` need onto the detector's device."""
        self._laid = Recorded(self._laid_there)

    def on_device(self, device: str, worth: int | None = None) -> Self:
        """As `robosac.detectors.base.Placeable.on_device`.

        ``worth`` is how many subsets its frames decode at once. By default it is 1 on the processor, and `WORTH` on
        anything else.
        """
        other = deepcopy(self)
        other.device = as_device(device)
        other.worth = worth or (1 if other.device == CPU else WORTH)
        other.info = on_device(self.info, other.device)
        other.place()
        return other

    @abstractmethod
    def places(self, codes: torch.Tensor) -> torch.Tensor:
        """The box of each place, as `robosac.detectors.base.GeometricSurface.perceive` returns it."""

    def matrices(self, ego: Message, teammates: Collection[Message]) -> torch.Tensor:
        """Where in each teammate's map to look for the places of the ego's: (n, 2, 3), as `warp` takes them."""
        return torch.from_numpy(self._matrices(ego, teammates)).float()

    def _matrices(self, ego: Message, teammates: Collection[Message]) -> FloatArray:
        from_ego = planar(ego.pose, [each.pose for each in teammates])
        return sampling_matrices(from_ego, self.info.area_m[2], self.mirrored)

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedMaps:
        """Warp every teammate's map into the ego's frame, once."""
        prepared = PreparedMaps(self, ego)
        prepared.add(teammates)
        return prepared

    def laid(self, ego: Message, teammates: Sequence[Message]) -> Iterator[torch.Tensor]:
        """Maps (C, H, W) of teammates as they lie in the ego's frame."""
        if self.device != CPU:
            sent = gone_up(_features(teammates), self.device)
            matrices = self._matrices(ego, teammates).astype(np.float32)
            (laid,) = self._laid(sent, gone_up([matrices], self.device)[0])
            return iter(laid.clone())
        return self._laid_here(ego, teammates)

    def _laid_there(self, sent: torch.Tensor, matrices: torch.Tensor) -> Tensors:
        channels, *size = sent.shape[1:]
        parts = math.gcd(channels, PARTS)
        moves = matrices[:, None].expand(-1, parts, -1, -1).flatten(0, 1)
        laid = warp(sent.float().view(-1, channels // parts, *size), moves).view(sent.shape)
        return ((laid / self.gain).contiguous(memory_format=torch.channels_last),)

    def _laid_here(self, ego: Message, teammates: Sequence[Message]) -> Iterator[torch.Tensor]:
        height, width = teammates[0].tensors[FEATURES].shape[1:]
        cells, shares = corners(self._matrices(ego, teammates), height, width)
        shares /= self.gain
        for first in range(0, len(teammates), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            yield from gathered(by_cell(_features(teammates[some])), cells[some], shares[some])

    def attack_surface(self, ego: Message, teammates: Mapping[str, Message]) -> MapSurface:
        """Show a frame to an attacker."""
        return MapSurface(self, ego, teammates)

    def perturbed(self, message: Message, tensor: torch.Tensor) -> Message:
        """Put a map (C, H, W) into a teammate's message, rounded to the type of its maps."""
        dtype = self.info.tensors["teammate"][FEATURES].dtype
        return Message(message.pose, {**message.tensors, FEATURES: tensor.detach().contiguous().numpy().astype(dtype)})


def _features(messages: Collection[Message]) -> list[Tensor]:
    return [message.tensors[FEATURES] for message in messages]


def combined(maps: torch.Tensor, weights: FloatArray) -> torch.Tensor:
    """Sums (n, C, H, W) of maps (m, C, H, W), each with its weight in a row of ``weights`` (n, m), float32."""
    cells = maps.permute(0, 2, 3, 1)
    sums = gone_up([weights], maps.device)[0] @ cells.flatten(1)
    return sums.view(-1, *cells.shape[1:]).permute(0, 3, 1, 2)


class PreparedMaps:
    """A frame to be decoded for many subsets.

    See `robosac.detectors.base.PreparedFrame`, and `Growing` and `Joining` there.
    """

    def __init__(self, detector: MapFusionDetector, ego: Message) -> None:
        self._detector = detector
        self._ego = ego
        with torch.inference_mode():
            self.own = by_cell(_features([ego]), detector.device)[0] / detector.gain
            self._context = detector.context(ego, self.own)
        self.warped: dict[str, torch.Tensor] = {}
        self._together: torch.Tensor | None = None

    @property
    def worth(self) -> int:
        """As the detector's."""
        return self._detector.worth

    @property
    def family(self) -> object:
        """The detector."""
        return self._detector

    def add(self, teammates: Mapping[str, Message]) -> None:
        """Warp the maps of these teammates."""
        if teammates:
            with torch.inference_mode():
                laid = self._detector.laid(self._ego, list(teammates.values()))
                self.warped.update(zip(teammates, laid, strict=True))
            self._together = None

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of the ego fused with these teammates; with none, of the ego alone."""
        with torch.inference_mode():
            fused = self._detector.fused([self.own, *(self.warped[name] for name in teammates)])
            return self._detector.find(fused[None], [self._context])[0]

    def detect_all(self, subsets: Subsets) -> list[FloatArray]:
        """Boxes (k, 6) of each subset, as `detect` gives them but for rounding."""
        return self.detect_together([(self, subsets)])[0]

    @staticmethod
    def detect_together(wanted: Sequence[tuple[PreparedMaps, Subsets]]) -> list[list[FloatArray]]:
        """As `detect_all`, of several frames of a detector, each with subsets of its own."""
        contexts = [frame._context for frame, subsets in wanted for _ in subsets]
        with torch.inference_mode():
            fused = [frame._fused_for(subsets) for frame, subsets in wanted]
            together = fused[0] if len(fused) == 1 else torch.cat(fused)
            found = iter(wanted[0][0]._detector.find(together, contexts))
        return [list(islice(found, len(subsets))) for _, subsets in wanted]

    def _fused_for(self, subsets: Subsets) -> torch.Tensor:
        """The fused map (n, C, H, W) of each subset."""
        row = {name: i for i, name in enumerate(self.warped, 1)}
        chosen = np.zeros((len(subsets), 1 + len(row)), dtype=np.float32)
        chosen[:, 0] = 1.0
        for i, subset in enumerate(subsets):
            chosen[i, [row[name] for name in subset]] = 1.0
        if self._together is None:
            # a map that overflowed is none of those that are fused without it, but infinity times 0 is no number
            cells = torch.stack([each.permute(1, 2, 0) for each in (self.own, *self.warped.values())])
            self._together = torch.nan_to_num(cells).permute(0, 3, 1, 2)
        return self._detector.fused_of_each(self._together, chosen)


class MapSurface:
    """A frame for an attacker; see `robosac.detectors.base.GeometricSurface`. Benign maps are warped only once."""

    def __init__(self, detector: MapFusionDetector, ego: Message, teammates: Mapping[str, Message]) -> None:
        own, *others = stacked(_features([ego, *teammates.values()]))
        self.messages = dict(zip(teammates, others, strict=True))
        self._detector = detector
        with torch.no_grad():
            self._own = own / detector.gain
            self._decode = detector.decoder(ego, self._own)
        self._matrices = {name: detector.matrices(ego, [message]) for name, message in teammates.items()}
        self._benign = {name: self._warp(name, tensor) for name, tensor in self.messages.items()}

    def class_logits(self, messages: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Class logits of the ego fused with these messages."""
        return self._heads(messages)[0]

    def perceive(self, messages: Mapping[str, torch.Tensor]) -> Heads:
        """Class logits, and the box of each."""
        logits, codes = self._heads(messages)
        return logits, self._detector.places(codes)

    def _heads(self, messages: Mapping[str, torch.Tensor]) -> Heads:
        warped = [
            self._benign[name] if tensor is self.messages[name] else self._warp(name, tensor)
            for name, tensor in messages.items()
        ]
        return self._decode([self._own, *warped])

    def _warp(self, name: str, tensor: torch.Tensor) -> torch.Tensor:
        return warp(tensor[None] / self._detector.gain, self._matrices[name])[0]
