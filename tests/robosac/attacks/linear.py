"""A detector in closed form: what an attack should do to it is known."""

import numpy as np
import torch

from robosac.attacks import Situation
from robosac.detectors import Message

VEHICLES = np.array([[x, y, 4.0, 2.0, yaw] for x in (3.0, 13.0, 23.0) for y in (-5.0, 5.0) for yaw in (0.0, 1.6)])
"""True boxes with gaps between them, none of them where `Linear` has a place."""


class Linear:
    """An ego that adds up all messages: a cell's sum is its class logit, and half of it moves the next cell's box in y.

    Boxes stand 10 m apart, 4 m long, 2 m wide, along +x.
    """

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
        constants = (torch.full_like(total, value) for value in (1.4, 0.7, 1.0, 0.0))
        return total, torch.stack([x, y + 0.5 * total.roll(1), *constants], dim=-1)


def hidden(surface):
    """Boxes of what the ego alone does not see and its teammates do."""
    with torch.no_grad():
        own, (fused, boxes) = surface.class_logits({}), surface.perceive(surface.messages)
    return np.array([[*box[:2], 4.0, 2.0, 0.0] for box in boxes[(own < -3) & (fused > 1)].tolist()]).reshape(-1, 5)


def situation(surface, **changes):
    """A first frame of a `Linear` ego, among `VEHICLES` and those that are hidden from it."""
    return Situation(**{"truth": np.vstack([VEHICLES, hidden(surface)]), **changes})


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
