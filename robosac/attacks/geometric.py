"""What attacks share that look at boxes, not only at class scores."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from torch.nn import functional

from robosac.attacks.base import SEEN, Tensors
from robosac.detectors.base import AttackSurface, GeometricSurface

CERTAIN = 0.5
"""Places with a score from here on hold a box for certain. A defence can judge how these boxes move."""

SHOWN = ("class_logits", "perceive")
"""What attacks that look at boxes call of an attack surface."""


class NoGeometry(ValueError):
    """An attack needs boxes of a detector that shows attackers class scores only."""


@dataclass(frozen=True)
class Perception:
    """What the ego makes of a set of messages."""

    scores: torch.Tensor
    """Class scores in [0, 1]."""
    geometry: torch.Tensor
    """Of the same shape and six more, as `robosac.detectors.base.GeometricSurface.perceive` gives it."""

    @classmethod
    def of(cls, surface: AttackSurface, team: Collection[str], sent: Tensors | None = None) -> Perception:
        """Of these teammates' messages: those that are sent, of all others the benign ones."""
        met = {**surface.messages, **(sent or {})}
        with torch.no_grad():
            logits, geometry = geometric(surface).perceive({name: met[name] for name in team})
        return cls(torch.sigmoid(logits), geometry)


def geometric(surface: AttackSurface) -> GeometricSurface:
    """The same surface, if it shows boxes.

    Raises
    ------
    NoGeometry
        If it shows class scores only.
    """
    if not isinstance(surface, GeometricSurface):
        raise NoGeometry("this attack needs a detector whose attack surface has `perceive`")
    return surface


def balanced(logits: torch.Tensor, wanted: torch.Tensor, matters: torch.Tensor) -> torch.Tensor:
    """Cross-entropy in which the places that matter count as much together as all others, which are many and empty.

    Parameters
    ----------
    logits, wanted : tensors of one shape
        Class logits, and scores in [0, 1] that they should have.
    matters : bool tensor of that shape
    """
    loss = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    return average(loss, matters) + average(loss, ~matters)


def average(values: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """Mean over the places of a mask; 0 over none."""
    return values[where].sum() / max(int(where.sum()), 1)


def displacement(geometry: torch.Tensor, wanted: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """How far boxes are from where they should be: the summed differences, averaged over the places of a mask.

    Metres of the centre, logarithms of the sides and the two numbers of the yaw are summed as they are. A unit of any
    of them costs a car about as much overlap.
    """
    return average((geometry - wanted).abs().sum(dim=-1), where)


def unnoticed(surface: AttackSurface, team: Collection[str], sent: Tensors, honest: Perception) -> torch.Tensor:
    """How far a fusion is from the one in which all are honest. At best it is the entropy of the honest scores.

    Parameters
    ----------
    surface : AttackSurface
        The frame.
    team : collection of str
        Who is fused.
    sent : mapping of attacker to tensor
        In place of the benign messages.
    honest : Perception
        Of that team's benign messages.
    """
    logits, geometry = geometric(surface).perceive({n: sent.get(n, surface.messages[n]) for n in team})
    seen = honest.scores >= SEEN
    moved = displacement(geometry, honest.geometry, honest.scores >= CERTAIN)
    return balanced(logits, honest.scores, seen) + moved
