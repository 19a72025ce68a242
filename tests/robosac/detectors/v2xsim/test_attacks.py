"""Attacks on objects against a detector with anchors."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from robosac.attacks import Lie, OnObjects, Remove, Situation, penalties
from robosac.attacks.objects import View


@dataclass(frozen=True)
class Told(OnObjects):
    """An attack whose lie is settled beforehand."""

    steps: int = 3
    step_size: float = 0.01
    lie: Lie | None = None

    def lies(self, scope, rng):
        return [self.lie]


@pytest.fixture(scope="module")
def surface(v2xsim, scans):
    messages = {name: v2xsim.encode(points, pose) for name, (points, pose) in scans.items()}
    ego = messages.pop("car-1")
    return v2xsim.attack_surface(ego, messages)


@pytest.mark.parametrize("kind", ["ghost", "erased", "moved"])
def test_the_loss_of_every_lie_falls(kind, surface):
    box = np.array([8.0, -6.0, 4.0, 2.0, 0.3])
    lie = Lie(kind, box, truth=box + [0, 1.2, 0, 0, 0] if kind == "moved" else None)
    attack, met = Told(lie=lie), Situation()
    sent = attack.run(surface, ["car-2"], np.random.default_rng(0), met)
    aim = attack.aim(surface, ["car-2"], met)
    with torch.no_grad():
        before, after = (float(aim({"car-2": m}, {})) for m in (surface.messages["car-2"], sent["car-2"]))
    assert after < before
    assert 0 < float((sent["car-2"] - surface.messages["car-2"]).abs().max()) <= 0.5 + 1e-6


def test_penalties_have_gradients(surface):
    message = {"car-2": surface.messages["car-2"].clone().requires_grad_(True)}
    memory = {}
    penalties.remember(Situation(memory=memory), surface, {"car-2": surface.messages["car-2"] + 0.2})
    met = Situation(1, memory=memory)
    paid = torch.stack([penalty(met, surface, message) for penalty in penalties.PENALTIES]).sum()
    (gradient,) = torch.autograd.grad(paid, message["car-2"])
    assert torch.isfinite(gradient).all()
    assert gradient.abs().sum() > 0


def test_what_is_shown_is_bounded(surface):
    view = View.of(surface, Situation())
    assert len(view.shown(view.honest, 0.0)) == 2000
    assert Remove().run(surface, ["car-2"], np.random.default_rng(0), Situation()) == {}
