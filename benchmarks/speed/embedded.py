"""Frames of the embedded detector: one, and sequences."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from audit_records import like

from robosac.attacks import PGD
from robosac.detectors import Detector, Message, load
from robosac.evaluation.frames import EvaluationFrame, Sensed, under_attack
from robosac.scenes import IntersectionScene

EGO = "car-1"
FIRST_SCENE = 1600
FRAMES = 16
STEPS = 20
"""Of the ascent of a message that floods."""


def frame() -> tuple[Detector, Message, dict[str, Message]]:
    """A detector, an ego's message, and those of its five teammates."""
    detector = load()
    views = IntersectionScene(seed=3).frame(0).views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    return detector, messages.pop(EGO), messages


@lru_cache(maxsize=4)
def sequence(attackers: int, frames: int = FRAMES) -> tuple[EvaluationFrame, ...]:
    """Successive frames of a validation scene, so many of the five teammates PGD attackers."""
    detector, rng = load(), np.random.default_rng(0)
    scene = IntersectionScene(FIRST_SCENE)
    bad = sorted(set(scene.agents) - {EGO})[:attackers]
    return tuple(
        under_attack(detector, Sensed.of(detector, scene.frame(index), EGO, 0.0, rng), bad, PGD(), rng)
        for index in range(frames)
    )


def flooding(met: EvaluationFrame, name: str) -> dict[str, Message]:
    """A frame's messages, with one that makes boxes wherever it can, with values as large as honest ones hold."""
    surface = met.detector.attack_surface(met.ego, met.teammates)
    honest = surface.messages[name]
    most, sent = float(honest.max()), honest.clone()
    for _ in range(STEPS):
        sent.requires_grad_(True)
        surface.class_logits({**surface.messages, name: sent}).sum().backward()
        assert sent.grad is not None
        sent = (sent + most / STEPS * sent.grad.sign()).clamp(0.0, most).detach()
    return {**met.teammates, name: met.detector.perturbed(met.teammates[name], sent)}


def enlarged(teammates: Mapping[str, Message], count: int, rng: np.random.Generator) -> dict[str, Message]:
    """So many teammates: those, and others like them."""
    team = sorted(teammates)
    more = {f"more-{i:03d}": like(teammates[team[i % len(team)]], rng) for i in range(count - len(team))}
    return {**teammates, **more}
