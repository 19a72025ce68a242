"""A detector in closed form: what an attack should do to it is known."""

import numpy as np
import torch

from robosac.attacks import Hearing, Situation
from robosac.boxes import pose_matrix
from robosac.detectors import Message
from robosac.testimony import ACROSS, ALONG, LAYERS, LIKELIHOOD

VEHICLES = np.array([[x, y, 4.0, 2.0, yaw] for x in (3.0, 13.0, 23.4) for y in (-5.0, 5.0) for yaw in (0.0, 1.6)])
"""True boxes with gaps between them, none of them where `Linear` has a place."""


class Linear:
    """An ego that adds up all messages: a cell's sum is its class logit, and half of it moves the next cell's box in y.

    Boxes stand 10 m apart, 4 m long, 2 m wide, along +x. Where it `bends`, a sum lengthens the box after the next by so
    much (its logarithm), and turns the one after that.
    """

    bends = 0.0

    def __init__(self, shape=(3, 4), seed=0):
        generator = torch.Generator().manual_seed(seed)
        self.ego = torch.randn(shape, generator=generator) * 3
        self.messages = {name: torch.randn(shape, generator=generator) * 0.1 for name in ("a", "b", "c")}

    def class_logits(self, messages):
        total = self.ego
        for message in messages.values():
            total = total + message
        return total

    def perceive(self, messages):
        total = self.class_logits(messages)
        y, x = torch.meshgrid(*(10.0 * torch.arange(n) for n in total.shape), indexing="ij")
        moved, longer, turned = (factor * total.roll(n) for n, factor in enumerate((0.5, self.bends, self.bends), 1))
        width, cos = torch.full_like(total, 0.7), torch.ones_like(total)
        return total, torch.stack([x, y + moved, 1.4 + longer, width, cos, turned], dim=-1)


class LinearWitness:
    """Reads a map (H, W) of cells of 80 m / W: L grows by ``gain`` with each value, from what the sender says at 0.

    A sender is known by the height of its sensor. Vehicles are seen in the middle of their cells.
    """

    half_extent_m = 40.0

    def __init__(self, at_zero, gain=10.0):
        self.layout, self._at_zero, self._gain = self, at_zero, gain

    def scaled(self, maps):
        return maps

    def read(self, maps, heights):
        testimony = torch.zeros(len(maps), LAYERS, *maps.shape[1:])
        testimony[:, LIKELIHOOD] = torch.tensor([self._at_zero[round(h)] for h in heights])[:, None, None]
        testimony[:, LIKELIHOOD] += self._gain * maps
        testimony[:, [ALONG, ACROSS]] = np.log(0.2)
        return testimony


def pose(height, x=0.0):
    return pose_matrix(x, 0.0, height, 0.0)


def hearing(surface, at_zero=(-1.0, 0.0, 6.0, 6.0), **options):
    """The ego and a hear of all places and are not sure; b knows those with x < 10, c those with x > 16."""
    west_to_east = {"a": 0.0, "b": -30.0, "c": 56.0}
    poses = {name: pose(n, west_to_east[name]) for n, name in enumerate(surface.messages, start=1)}
    ego = torch.zeros_like(surface.ego)
    return Hearing(LinearWitness(at_zero, **options), ego, pose(0), surface.messages, poses)


def hidden(surface):
    """Boxes of what the ego alone does not see and its teammates do."""
    with torch.no_grad():
        own, (fused, boxes) = surface.class_logits({}), surface.perceive(surface.messages)
    return np.array([[*box[:2], 4.0, 2.0, 0.0] for box in boxes[(own < -3) & (fused > 1)].tolist()]).reshape(-1, 5)


def situation(surface, **changes):
    """A first frame of a `Linear` ego, among `VEHICLES` and those that are hidden from it."""
    known = {"truth": np.vstack([VEHICLES, hidden(surface)]), "hearing": hearing(surface)}
    return Situation(**{**known, **changes})


def message(tensor):
    return Message(np.eye(4), {"map": tensor.numpy()})


def after_another_frame(attack, surface, attackers, seed=1):
    """The situation in which an attack finds itself after it has met a frame, with all that there is to know."""
    before, rng, memory = Linear(seed=seed), np.random.default_rng(0), {}
    attack.run(before, attackers, rng, situation(before, memory=memory))
    return situation(
        surface,
        frame=1,
        memory=memory,
        earlier={0: {name: message(tensor) for name, tensor in before.messages.items()}},
        foreign=lambda name, frame: message(Linear(seed=2).messages[name]),
        tensor=lambda sent: torch.from_numpy(sent.tensors["map"]),
    )
