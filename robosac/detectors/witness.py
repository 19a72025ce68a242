"""A small network that reads one agent's message alone, and says for every place what is there.

It belongs to a detector's weights, but is no part of the detector: it decodes no fusion. What it says of a message
depends on that message only, so no other agent can change it. `robosac.calibration.witness` trains it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message, Precision
from robosac.detectors.device import as_device
from robosac.detectors.fast_witness import FastWitness
from robosac.detectors.warp import sampling_matrices, warp
from robosac.detectors.weights_file import WeightsError, read_weights, save_weights
from robosac.detectors.witness_network import Layout, WitnessNetwork
from robosac.steps import Steps, finished
from robosac.testimony import LAYERS, LIKELIHOOD, Testimony, planar

Float16Array = np.ndarray[Any, np.dtype[np.float16]]
LARGEST = 50.0
"""Whatever a message holds, nothing is read from it that is farther from 0: half floats would become infinite, and what
is laid over the ego's map no number.
"""
AT_ONCE = 8
"""Messages read together: between groups it is looked at whether there is time for another one."""


class Witness:
    """A trained network, and how the messages of its detector are read.

    Parameters
    ----------
    network : WitnessNetwork
        On the device where messages are to be read. What `testify` does with it is made ready here: a network that
        learns more needs another witness.
    layout : Layout
    precision : str
        That of the detector, see `FastWitness`.
    """

    def __init__(self, network: WitnessNetwork, layout: Layout, precision: Precision = "float32") -> None:
        self.network = network.eval().requires_grad_(False)
        self.layout = layout
        self._fast = FastWitness(self.network, layout, precision)

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
            read = self._fast.read(messages).nan_to_num_().clamp_(-LARGEST, LARGEST).half()
            maps: Float16Array = read.flatten(4).flatten(2, 3).cpu().numpy()
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
        """Read what `write` wrote for this detector, to its device and in its precision.

        Raises
        ------
        WeightsError
            If the file is damaged, or belongs to other weights.
        """
        tensors, kept = read_weights(path)
        if kept.get("weights_digest") != info.weights_digest:
            raise WeightsError(
                f"{path.name} belongs to weights with the digest {kept.get('weights_digest')!s:.12}..., not to "
                f"{info.name} with {info.weights_digest:.12}...: make it anew (robosac witness)"
            )
        layout = Layout.of(info, float(kept["scale"]))
        network = WitnessNetwork(layout.channels, layout.upsampling)
        try:
            network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        except RuntimeError as error:
            raise WeightsError(f"{path} does not fit the messages of {info.name}: {error}") from error
        return cls(network.to(as_device(info.device)), layout, info.precision)


def as_testimony(agents: tuple[str, ...], maps: Float16Array, from_ego: FloatArray, half_extent_m: float) -> Testimony:
    """Testimony of maps (agents, LAYERS, H, W), laid over the ego's; as `Testimony` has them, but float16."""
    moves = torch.from_numpy(sampling_matrices(from_ego, half_extent_m)).float()
    with torch.inference_mode():
        wide = torch.from_numpy(maps).float()
        over_ego = warp(wide[:, LIKELIHOOD, None], moves)[:, 0].numpy()
    return Testimony(agents, wide.numpy(), from_ego, over_ego, half_extent_m)
