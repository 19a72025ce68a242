"""Attacks on single objects: cars that do not exist, vanish, stand elsewhere, or look otherwise.

They all share one loss, made of what they say that they lie about (`robosac.attacks.situation.Lie`). So an attack only
says in each frame what its lies are, and a lie that is held in the world is held by saying it again.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch.nn import functional

from robosac.attacks.base import SEEN, Aim, IterativeAttack, Tensors
from robosac.attacks.geometric import CERTAIN, SHOWN, Perception, average, balanced, displacement, geometric
from robosac.attacks.places import Room
from robosac.attacks.returned import AttackError
from robosac.attacks.situation import Lie, Situation
from robosac.boxes import FloatArray
from robosac.detectors.base import AttackSurface

CRISP = 2.0
"""Class logit that a made-up object should have: a score of .88."""
GONE = -3.5
"""Class logit that no place of an erased object should exceed: a score of .03."""
FAINT = -1.4
"""Class logit of the surest place of a dimmed object: a score of .2, too little to count as seen."""
FAR_M = 1.5
"""What should be seen farther away than this is erased where it is, and made up where it is not."""
NEAR_M = 2.5
"""Places whose boxes are centred so near to an object may show it."""
MOST_PLACES = 2000
"""So many places, the best, are looked at to see what is shown. It bounds the search where there are many anchors."""
HARM = 3.0
"""Weight of the lies, where everything else that should stay as it is has the weight 1."""
Harm = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Of what `robosac.detectors.base.GeometricSurface.perceive` gives, a scalar."""


@dataclass(frozen=True)
class View:
    """What the ego makes of the benign messages."""

    ego: Perception
    honest: Perception
    """Of its own alone, and of all."""

    @classmethod
    def of(cls, surface: AttackSurface, situation: Situation) -> View:
        """Of a frame; it is made once."""
        view: View = situation.once(
            "view", lambda: cls(Perception.of(surface, ()), Perception.of(surface, surface.messages))
        )
        return view

    def shown(self, perception: Perception, score: float) -> FloatArray:
        """Centres (n, 2) of the places of a perception with a score from here on, at most `MOST_PLACES`; ego frame."""
        scores = perception.scores.flatten()
        best = scores.topk(min(MOST_PLACES, len(scores)))
        chosen = best.indices[best.values >= score]
        centres: FloatArray = perception.geometry.reshape(-1, 6)[chosen, :2].double().numpy()
        return centres


@dataclass(frozen=True)
class Scope:
    """What lies are chosen by."""

    situation: Situation
    view: View
    attackers: Collection[str]

    @property
    def liars(self) -> FloatArray:
        """(k, 2): where the attackers are, ego frame; the ego's own place where nobody knows."""
        return self._centres(self.attackers)

    @property
    def room(self) -> Room:
        """What leaves no room for made-up objects."""
        shown = [self.view.shown(perception, SEEN) for perception in (self.view.ego, self.view.honest)]
        return Room(self.situation.truth, self.agents, np.vstack(shown), self.liars)

    @property
    def agents(self) -> FloatArray:
        """(n, 2): where all are who sense, the ego first; ego frame."""
        return np.vstack([np.zeros((1, 2)), self._centres(self.situation.poses)])

    def _centres(self, names: Collection[str]) -> FloatArray:
        poses = [self.situation.poses.get(name, self.situation.ego_pose) for name in names]
        boxes = np.array([[pose[0, 3], pose[1, 3], 0.0, 0.0, 0.0] for pose in poses]).reshape(-1, 5)
        centres: FloatArray = self.situation.around_ego(boxes)[:, :2]
        return centres


@dataclass(frozen=True)
class OnObjects(IterativeAttack):
    """An attack on objects: in each frame it says what its lies are, and makes them show.

    Minimises over the attackers' messages, in the fusion of the whole team::

        HARM * mean over lies (loss of the lie) + cross-entropy + displacement

    - a *ghost*: ``max(0, CRISP - logit)`` of the place that would show it most easily, and how far that place's box is
      from the ghost;
    - *erased*: ``max(0, logit - GONE)``, averaged over all places whose boxes are near it;
    - *dimmed*: as erased, but down to `FAINT`, and no farther;
    - *moved*: how far the centres of the boxes that show it are from where they should be; if that is farther away than
      `FAR_M`, it is a ghost there, and erased where it is;
    - *reshaped*: how far the boxes that show it are from what they should be, by all six numbers;
    - cross-entropy between all other class scores and the benign ones, `balanced`, and `displacement` of all other
      certain boxes.

    Steps are small and many, as in `robosac.attacks.still`, and begin with what the frame before ended with.
    """

    needs: ClassVar[tuple[str, ...]] = SHOWN
    remembers: ClassVar[bool] = True

    steps: int = 30
    step_size: float = 0.04

    @abstractmethod
    def lies(self, scope: Scope, rng: np.random.Generator) -> list[Lie]:
        """What the attack lies about in this frame; with nothing to lie about, all its messages are benign."""

    def prepare(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,
        situation: Situation,
    ) -> bool:
        """Choose the lies, and say them."""
        told = self.lies(Scope(situation, View.of(surface, situation), tuple(attackers)), rng)
        if not isinstance(told, list) or not all(isinstance(lie, Lie) for lie in told):
            who = getattr(self, "name", type(self).__name__)
            raise AttackError(f"{who}: lies must return a list of Lie, got {told!r:.100}")
        situation.lies.extend(told)
        return bool(situation.lies)

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:  # noqa: ARG002
        """The loss of the situation's lies, and of all that should stay."""
        honest, shown = View.of(surface, situation).honest, geometric(surface)
        told = harm(situation.lies, honest)
        held = torch.ones_like(honest.scores, dtype=torch.bool)
        for lie in situation.lies:
            if lie.kind not in ("moved", "reshaped") or _is_far(lie):
                held &= _apart(honest.geometry, lie.box) > NEAR_M
            if lie.truth is not None and _is_far(lie):
                held &= _apart(honest.geometry, lie.truth) > NEAR_M
        still = held & (honest.scores >= CERTAIN)
        for lie in situation.lies:
            if lie.truth is not None:
                still &= _apart(honest.geometry, lie.truth) > NEAR_M

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:  # noqa: ARG001
            logits, boxes = shown.perceive({**surface.messages, **sent})
            kept = balanced(logits[held], honest.scores[held], honest.scores[held] >= SEEN)
            kept = kept + displacement(boxes, honest.geometry, still)
            return kept + told(logits, boxes) if situation.lies else kept

        return loss


def _apart(boxes: torch.Tensor, box: FloatArray) -> torch.Tensor:
    """Distance (...) of the centres of boxes (..., 6) from that of a box (5,), metres."""
    apart: torch.Tensor = torch.linalg.vector_norm(boxes[..., :2] - torch.from_numpy(box[:2]).to(boxes), dim=-1)
    return apart


def codes(box: FloatArray) -> torch.Tensor:
    """A box (5,) as `robosac.detectors.base.GeometricSurface.perceive` gives boxes: (6,) float32."""
    x, y, length, width, yaw = box[:5]
    return torch.tensor([x, y, np.log(length), np.log(width), np.cos(2 * yaw), np.sin(2 * yaw)], dtype=torch.float32)


class _Ghost:
    def __init__(self, lie: Lie, honest: Perception) -> None:
        self._wanted = codes(lie.box)
        flat = honest.geometry.reshape(-1, 6)
        self._place = int((flat - self._wanted).abs().sum(dim=1).argmin())

    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        box = boxes.reshape(-1, 6)[self._place]
        return functional.relu(CRISP - logits.flatten()[self._place]) + (box - self._wanted).abs().sum()


class _Erased:
    def __init__(self, lie: Lie, honest: Perception) -> None:
        self._box = lie.box
        self._showed = _apart(honest.geometry, lie.box) <= NEAR_M

    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        return _excess(logits[self._showed | (_apart(boxes.detach(), self._box) <= NEAR_M)], GONE)


class _Dimmed(_Erased):
    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        shows = logits[self._showed | (_apart(boxes.detach(), self._box) <= NEAR_M)]
        return _excess(shows, FAINT) + (functional.relu(FAINT - shows.max()) if len(shows) else 0.0)


class _Moved:
    def __init__(self, lie: Lie, honest: Perception) -> None:
        true = lie.box if lie.truth is None else lie.truth
        self._wanted = codes(lie.box)[:2]
        self._shows = (_apart(honest.geometry, true) <= NEAR_M) & (honest.scores >= SEEN)

    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        return average((boxes[..., :2] - self._wanted).abs().sum(dim=-1), self._shows)


class _Reshaped:
    def __init__(self, lie: Lie, honest: Perception) -> None:
        self._wanted = codes(lie.box)
        self._shows = (_apart(honest.geometry, lie.box) <= NEAR_M) & (honest.scores >= SEEN)

    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        return average((boxes - self._wanted).abs().sum(dim=-1), self._shows)


class _Carried:
    def __init__(self, lie: Lie, honest: Perception) -> None:
        self._ghost, self._lie = _Ghost(lie, honest), lie.box
        self._true = lie.box if lie.truth is None else lie.truth

    def __call__(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        from_true, from_lie = (_apart(boxes.detach(), box) for box in (self._true, self._lie))
        return self._ghost(logits, boxes) + _excess(logits[(from_true <= NEAR_M) & (from_true < from_lie)], GONE)


def _excess(logits: torch.Tensor, most: float) -> torch.Tensor:
    """The mean of what logits (n,) are above the most that they should be, of those that are."""
    excess = functional.relu(logits - most)
    return excess.sum() / max(int((excess > 0).sum()), 1)


def _is_far(lie: Lie) -> bool:
    return lie.truth is not None and bool(np.hypot(*(lie.box[:2] - lie.truth[:2])) > FAR_M)


def harm(lies: Sequence[Lie], honest: Perception) -> Harm:
    """The weighted mean of the losses of some lies, see `OnObjects`; ``honest`` is the fusion of benign messages."""
    losses = [_Carried(lie, honest) if _is_far(lie) else _LOSSES[lie.kind](lie, honest) for lie in lies]
    return lambda logits, boxes: HARM * torch.stack([each(logits, boxes) for each in losses]).mean()


_LOSSES: Mapping[str, type[_Ghost] | type[_Erased] | type[_Moved] | type[_Reshaped]] = {
    "ghost": _Ghost,
    "erased": _Erased,
    "dimmed": _Dimmed,
    "moved": _Moved,
    "reshaped": _Reshaped,
}
