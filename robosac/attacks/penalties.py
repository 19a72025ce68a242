"""What an attack pays for being seen: differentiable forms of what a defence measures.

The attack minimises its own aim and, weighted, the sum of `PENALTIES`. Another penalty is a function and its place in
that list. A penalty is called in every step of the attack. What it needs once in a frame, `Situation.once` keeps. They
may share passes, so only their sum can be differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from robosac.attacks.base import Tensors
from robosac.attacks.geometric import Perception, average, geometric
from robosac.attacks.situation import Situation
from robosac.boxes import FloatArray, nms
from robosac.defenses.group_testing.geometry import (
    ACROSS_M,
    ALONG_M,
    KNOWN_SCORE,
    NEW_SCORE,
    SURVIVOR_SCORE,
    WITNESS_SCORE,
)
from robosac.detectors.base import AttackSurface

Penalty = Callable[[Situation, AttackSurface, Tensors], torch.Tensor]
"""Of the situation, the surface and the attackers' present messages, a scalar: the smaller, the more honest they look.
"""

SUBSETS = 2
"""Random subsets of honest teammates with which the attackers' messages make pairs, in each frame anew."""
NEAR_M = 2.5
"""A box overlaps none that is centred farther away: more or less."""
SHARE = 3.0
"""Boxes that come or go are counted as their share of all boxes, times this: of 30 boxes each one weighs .1."""
MOST_BOXES = 300
MOST_PLACES = 4096
"""So many boxes and places, the best, are looked at. It bounds the work where there are many anchors."""
_NMS_IOU = 0.1
_SOFT = 0.5
_STREAM = 55
_SHOWN = "shown"


def _logit(score: float) -> float:
    return float(np.log(score / (1 - score)))


def _counts(logits: torch.Tensor, score: float) -> torch.Tensor:
    """About 1 where a logit is that of a score or more, about 0 elsewhere."""
    return torch.sigmoid((logits - _logit(score)) / _SOFT)


@dataclass(frozen=True)
class _Pair:
    """A fusion that the attackers join, and what it would look like if they were honest."""

    smaller: tuple[str, ...]
    joining: tuple[str, ...]
    before: Perception
    fresh: torch.Tensor
    """Mask of the places at which the smaller fusion shows nothing near."""
    loss: float
    novelty: float

    @classmethod
    def of(cls, surface: AttackSurface, smaller: Sequence[str], joining: Sequence[str]) -> _Pair:
        before = Perception.of(surface, smaller)
        honest = Perception.of(surface, [*smaller, *joining])
        apart = before.scores < KNOWN_SCORE
        known = torch.from_numpy(peaks(torch.logit(before.scores, eps=1e-6), before.geometry)[:, :2]).float()
        if len(known):
            apart[apart.clone()] &= torch.cdist(before.geometry[..., :2][apart], known).min(dim=1).values > NEAR_M
        pair = cls(tuple(smaller), tuple(joining), before, apart, 0.0, 0.0)
        logits = torch.logit(honest.scores, eps=1e-6)
        return cls(
            pair.smaller,
            pair.joining,
            before,
            apart,
            float(pair.lost(logits, honest.geometry)),
            float(pair.new(logits)),
        )

    def lost(self, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        """g: about one minus the mean overlap of what was certain with what is there now."""
        certain = self.before.scores >= WITNESS_SCORE
        overlap = torch.exp(-(boxes - self.before.geometry).abs().sum(dim=-1)) * _counts(logits, SURVIVOR_SCORE)
        return average(1.0 - overlap, certain)

    def new(self, logits: torch.Tensor) -> torch.Tensor:
        """v: places that show something where nothing was."""
        return _counts(logits[self.fresh], NEW_SCORE).sum()


def pairs(situation: Situation, surface: AttackSurface, sent: Tensors) -> torch.Tensor:
    """Geometric preservation loss g and novelty v (`robosac.defenses.group_testing.geometry.measure`), made smooth.

    Counted is by how much they exceed those of honest messages: in the pairs of each attacker with the ego alone, and
    of all together with random subsets of honest teammates. The mean over pairs of ``g + SHARE * v / boxes``.
    """
    met: tuple[list[_Pair], float] = situation.once("pairs", lambda: _pairs(situation, surface, sorted(sent)))
    all_pairs, boxes = met
    paid = []
    for pair in all_pairs:
        if pair.smaller:
            smaller = {name: surface.messages[name] for name in pair.smaller}
            logits, places = geometric(surface).perceive({**smaller, **sent})
        else:
            logits, places = _alone(situation, surface, sent, pair.joining[0])
        lost = torch.relu(pair.lost(logits, places) - pair.loss)
        paid.append(lost + SHARE * torch.relu(pair.new(logits) - pair.novelty) / boxes)
    return torch.stack(paid).mean()


def _pairs(situation: Situation, surface: AttackSurface, attackers: Sequence[str]) -> tuple[list[_Pair], float]:
    """The pairs of a frame, and how many places show something in the honest fusion of all."""
    rng = np.random.default_rng([_STREAM, situation.frame])
    honest = sorted(set(surface.messages) - set(attackers))
    chosen = [_Pair.of(surface, (), (name,)) for name in attackers]
    for _ in range(SUBSETS if honest else 0):
        size = int(rng.integers(1, len(honest) + 1))
        subset = sorted(str(name) for name in rng.choice(honest, size, replace=False))
        chosen.append(_Pair.of(surface, subset, attackers))
    everybody = Perception.of(surface, surface.messages)
    return chosen, max(float((everybody.scores >= NEW_SCORE).sum()), 1.0)


def changes(situation: Situation, surface: AttackSurface, sent: Tensors) -> torch.Tensor:
    """Boxes that come or go against the frame before (`robosac.defenses.group_testing.geometry.changes`), made smooth.

    In the fusions of the ego and each attacker, as each of them was shown in the frame before; 0 in the first one.
    """
    shown: dict[str, FloatArray] = situation.memory.get(_SHOWN, {})
    paid = [logits.sum() * 0.0 for logits in list(sent.values())[:1]]
    for name in sorted(set(sent) & set(shown)):
        before = torch.from_numpy(situation.around_ego(shown[name])).float()
        if len(before):
            logits, boxes = _alone(situation, surface, sent, name)
            paid.append(SHARE * _changed(before, logits.flatten(), boxes.reshape(-1, 6)) / len(before))
    return torch.stack(paid).sum() / max(len(sent), 1)


def _changed(before: torch.Tensor, logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
    """About how many of the boxes (m, 6) of before are gone, and how many came."""
    best = logits.detach().topk(min(MOST_PLACES, len(logits)))
    seen = best.indices[best.values > _logit(KNOWN_SCORE) - 2.0]
    logits, boxes = logits[seen], boxes[seen]
    if not len(logits):
        return (before[:, 5] >= WITNESS_SCORE).sum() + logits.sum()
    cos, sin = before[:, 4].cos(), before[:, 4].sin()
    x, y = (boxes[:, None, :2] - before[None, :, :2]).unbind(dim=-1)
    off = torch.maximum((cos * x + sin * y).abs() / ALONG_M, (cos * y - sin * x).abs() / ACROSS_M)
    came = _counts(logits, NEW_SCORE) * torch.sigmoid((off.min(dim=1).values - 1.0) / 0.2)
    here = torch.where(off.detach() < 1.0, logits[:, None], -10.0).max(dim=0).values
    gone = (1.0 - _counts(here, KNOWN_SCORE)) * (before[:, 5] >= WITNESS_SCORE)
    each = max(float((logits.detach() >= _logit(NEW_SCORE)).sum()) / len(before), 1.0)
    return came.sum() / each + gone.sum()


def _alone(situation: Situation, surface: AttackSurface, sent: Tensors, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """The fusion of the ego and one attacker, which several penalties look at; made once in a step."""
    last: dict[str, tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]] = situation.once("alone", dict)
    if name not in last or last[name][0] is not sent[name]:
        last[name] = (sent[name], geometric(surface).perceive({name: sent[name]}))
    return last[name][1]


def remember(situation: Situation, surface: AttackSurface, sent: Tensors) -> None:
    """Keep for the next frame's `changes` what each attacker's message, as it is sent, shows beside the ego."""
    with torch.no_grad():
        alone = {name: geometric(surface).perceive({name: tensor}) for name, tensor in sent.items()}
    boxes = {name: peaks(*heads) for name, heads in alone.items()}
    situation.memory[_SHOWN] = {name: situation.in_world(found) for name, found in boxes.items()}


def peaks(logits: torch.Tensor, boxes: torch.Tensor) -> FloatArray:
    """What a detector would show of the boxes (..., 6) of all places: (n, 6), x, y, length, width, yaw, score."""
    scores = torch.sigmoid(logits).flatten()
    best = scores.topk(min(MOST_BOXES, len(scores)))
    chosen = best.indices[best.values >= KNOWN_SCORE]
    x, y, length, width, cos, sin = boxes.reshape(-1, 6)[chosen].double().numpy().T
    score = scores[chosen].double().numpy()
    found = np.column_stack([x, y, np.exp(length), np.exp(width), np.arctan2(sin, cos) / 2, score])
    kept: FloatArray = found[nms(found, score, _NMS_IOU)]
    return kept


PENALTIES: list[Penalty] = [pairs, changes]
"""What an attack pays that wants to look honest to `group_testing`."""
