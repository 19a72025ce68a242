"""What detectors have in common whose messages hold one feature map.

Every teammate's map is laid over the ego's. The maps of a subset are fused into one, and that is decoded. Such a
detector is a subclass of `MapFusionDetector`, which says how its maps are fused and decoded.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from typing import ClassVar, Self

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message
from robosac.detectors.device import CPU, as_device, on_device, stacked
from robosac.detectors.warp import sampling_matrix, warp

FEATURES = "features"
"""The tensor of a message that holds its map."""
WORTH = 8
"""Subsets that an accelerator decodes at once, unless told otherwise: the ego alone, and seven hypotheses."""
Maps = Sequence[torch.Tensor]
Heads = tuple[torch.Tensor, torch.Tensor]
"""The class logit of each place where there might be a vehicle, and the codes of all boxes."""
Decode = Callable[[Maps], Heads]
"""From maps to fuse, the ego's first and all in its frame."""
Finder = Callable[[torch.Tensor], list[FloatArray]]
"""From fused maps (n, C, H, W) to the boxes of each."""


class MapFusionDetector(ABC):
    """A detector (`robosac.detectors.base.Detector`) but for its network and `encode`.

    Maps (C, H, W) have rows along +y. What an attacker perturbs is the map in the message, before it is warped.
    """

    info: DetectorInfo
    mirrored: ClassVar[bool] = False
    """Whether columns of the maps run along minus x."""
    device: torch.device = CPU
    """Where frames are prepared and decoded."""
    worth: int = 1
    """As `robosac.detectors.base.Batching.worth` of its frames."""

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
    def finder(self, ego: Message, own: torch.Tensor) -> Finder:
        """As `decoder`, but of fused maps, to the boxes of `robosac.detectors.base.PreparedFrame.detect`.

        It is on the detector's device, and without gradients.
        """

    @abstractmethod
    def place(self) -> None:
        """Put what `finder` needs onto the detector's device."""

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

    def unscaled(self, sent: torch.Tensor) -> torch.Tensor:
        """What is fused of maps as they are sent; by default all of it."""
        return sent

    def matrices(self, ego: Message, teammates: Collection[Message]) -> torch.Tensor:
        """Where in each teammate's map to look for the places of the ego's: (n, 2, 3), as `warp` takes them."""
        half_extent_m = self.info.area_m[2]
        matrices = [sampling_matrix(ego.pose, each.pose, half_extent_m, self.mirrored) for each in teammates]
        return torch.from_numpy(np.stack(matrices)).float()

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedMaps:
        """Warp every teammate's map into the ego's frame, once."""
        prepared = PreparedMaps(self, ego)
        prepared.add(teammates)
        return prepared

    def laid(self, ego: Message, teammates: Collection[Message]) -> torch.Tensor:
        """Maps (n, C, H, W) of teammates as they lie in the ego's frame."""
        sent = _sent(list(teammates), self.device)
        return warp(self.unscaled(sent), self.matrices(ego, teammates).to(self.device))

    def attack_surface(self, ego: Message, teammates: Mapping[str, Message]) -> MapSurface:
        """Show a frame to an attacker."""
        return MapSurface(self, ego, teammates)

    def perturbed(self, message: Message, tensor: torch.Tensor) -> Message:
        """Put a map (C, H, W) into a teammate's message, rounded to the type of its maps."""
        dtype = self.info.tensors["teammate"][FEATURES].dtype
        return Message(message.pose, {**message.tensors, FEATURES: tensor.detach().contiguous().numpy().astype(dtype)})


def _sent(messages: Sequence[Message], device: torch.device = CPU) -> torch.Tensor:
    """Maps (n, C, H, W) as float32 in C order, as warped ones are."""
    return stacked([message.tensors[FEATURES] for message in messages], device)


def combined(maps: torch.Tensor, weights: FloatArray) -> torch.Tensor:
    """Sums (n, C, H, W) of maps (m, C, H, W), each with its weight in a row of ``weights`` (n, m), float32."""
    return (torch.from_numpy(weights).to(maps.device) @ maps.flatten(1)).reshape(-1, *maps.shape[1:])


class PreparedMaps:
    """A frame to be decoded for many subsets.

    See `robosac.detectors.base.PreparedFrame`, and `Growing` and `Batching` there.
    """

    def __init__(self, detector: MapFusionDetector, ego: Message) -> None:
        self._detector = detector
        self._ego = ego
        with torch.inference_mode():
            self.own = detector.unscaled(_sent([ego], detector.device))[0]
            self._find = detector.finder(ego, self.own)
        self.warped: dict[str, torch.Tensor] = {}
        self._together: torch.Tensor | None = None

    @property
    def worth(self) -> int:
        """As the detector's."""
        return self._detector.worth

    def add(self, teammates: Mapping[str, Message]) -> None:
        """Warp the maps of these teammates."""
        if teammates:
            with torch.inference_mode():
                warped = self._detector.laid(self._ego, teammates.values())
            self.warped.update(zip(teammates, warped, strict=True))
            self._together = None

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of the ego fused with these teammates; with none, of the ego alone."""
        with torch.inference_mode():
            fused = self._detector.fused([self.own, *(self.warped[name] for name in teammates)])
            return self._find(fused[None])[0]

    def detect_all(self, subsets: Sequence[Collection[str]]) -> list[FloatArray]:
        """Boxes (k, 6) of each subset, as `detect` gives them but for rounding."""
        row = {name: i for i, name in enumerate(self.warped, 1)}
        chosen = np.zeros((len(subsets), 1 + len(row)), dtype=np.float32)
        chosen[:, 0] = 1.0
        for i, subset in enumerate(subsets):
            chosen[i, [row[name] for name in subset]] = 1.0
        with torch.inference_mode():
            if self._together is None:
                # a map that overflowed is none of those that are fused without it, but infinity times 0 is no number
                self._together = torch.nan_to_num(torch.stack([self.own, *self.warped.values()]))
            return self._find(self._detector.fused_of_each(self._together, chosen))


class MapSurface:
    """A frame for an attacker; see `robosac.detectors.base.GeometricSurface`. Benign maps are warped only once."""

    def __init__(self, detector: MapFusionDetector, ego: Message, teammates: Mapping[str, Message]) -> None:
        own, *others = _sent([ego, *teammates.values()])
        self.messages = dict(zip(teammates, others, strict=True))
        self._detector = detector
        with torch.no_grad():
            self._own = detector.unscaled(own)
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
        return warp(self._detector.unscaled(tensor[None]), self._matrices[name])[0]
