"""A detector in closed form: what an attack should do to it is known."""

import numpy as np
import torch

from robosac.attacks import Situation

VEHICLES = np.array([[x, y, 4.0, 2.0, yaw] for x in (3.0, 13.0, 23.0) for y in (-5.0, 5.0) for yaw in (0.0, 1.6)])
"""True boxes with gaps between them, none of them where `Linear` has a place."""


class Linear:
    """An ego that adds up all messages: a cell's sum is its class logit, and half of it moves the next cell's box in y.

    Boxes stand 10 m apart, 4 m long, 2 m wide, along +x.
    """

    def __init__(self, shape=(3, 4)):
        generator = torch.Generator().manual_seed(0)
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


def situation(**changes):
    """A first frame of a `Linear` ego, among `VEHICLES`."""
    return Situation(**{"truth": VEHICLES, **changes})
