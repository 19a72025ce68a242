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

    @abstractmethod
    def fused(self, maps: Maps) -> torch.Tensor:
        """Maps (C, H, W), all in the ego's frame and the ego's first, as one."""

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

    def on_device(self, device: str) -> Self:
        """As `robosac.detectors.base.Placeable.on_device`."""
        other = deepcopy(self)
        other.device = as_device(device)
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


class PreparedMaps:
    """A frame to be decoded for many subsets; see `robosac.detectors.base.PreparedFrame`, and `Growing` there."""

    def __init__(self, detector: MapFusionDetector, ego: Message) -> None:
        self._detector = detector
        self._ego = ego
        with torch.inference_mode():
            self.own = detector.unscaled(_sent([ego], detector.device))[0]
            self._find = detector.finder(ego, self.own)
        self.warped: dict[str, torch.Tensor] = {}

    def add(self, teammates: Mapping[str, Message]) -> None:
        """Warp the maps of these teammates."""
        if teammates:
            with torch.inference_mode():
                warped = self._detector.laid(self._ego, teammates.values())
            self.warped.update(zip(teammates, warped, strict=True))

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of the ego fused with these teammates; with none, of the ego alone."""
        with torch.inference_mode():
            fused = self._detector.fused([self.own, *(self.warped[name] for name in teammates)])
            return self._find(fused[None])[0]


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
