"""What attackers make their own messages say: penalties, as those of `robosac.attacks.penalties`.

`group_testing` asks what each message says by itself of the objects that fusions show. An attacker cannot change what
another one's message says. It can choose what its own says, and that counts in two ways: who speaks against all others
is in conflict, and of a lie those are blamed first whose own message goes with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from robosac.attacks.base import Tensors
from robosac.attacks.hearing import Heard, Hearing, NoWitness
from robosac.attacks.objects import View
from robosac.attacks.penalties import peaks
from robosac.attacks.replays import replayed
from robosac.attacks.situation import Lie, Situation
from robosac.boxes import FloatArray
from robosac.detectors.base import AttackSurface
from robosac.testimony import MOST

SUPPORT, DENIAL = 4.0, -5.0
"""L that a message is to have, at least or at most, where it is to support or to deny: a little more than counts."""
SLACK = 1.0
"""L may differ by so much from that of the honest message."""
APART_M = 3.0
"""Nearer than this to an object that is spoken of, shown boxes are taken for it."""
SAME_M = 1.0
"""So are true vehicles that are nearer than this: others may stand in the next lane."""
WEIGHT = 3.0
"""Of what is said of those objects, where the pretences of whole fusions have the weight 1."""

Spoken = tuple[FloatArray, float]
"""A box (5,), ego frame, and the L that is wanted there: at least this if it is positive, else at most."""


def hearing_in(situation: Situation) -> Hearing:
    """What the adversary hears.

    Raises
    ------
    NoWitness
        If there is no witness.
    """
    if situation.hearing is None:
        raise NoWitness("this attack reads testimony: it needs a detector with a witness (robosac witness)")
    return situation.hearing


@dataclass(frozen=True, eq=False)
class Speech:
    """What some attackers' messages should say in a frame."""

    hearing: Hearing
    spoken: torch.Tensor
    """(m, 5): boxes that they speak of."""
    wanted: torch.Tensor
    """(m,): the L that is wanted there."""
    reached: torch.Tensor
    """(attackers, m): whose map they lie on."""
    kept: torch.Tensor
    """(k, 5): vehicles and shown boxes, of which they speak as they honestly do."""
    honest: torch.Tensor
    """(attackers, k): how that is."""

    @classmethod
    def of(
        cls, situation: Situation, surface: AttackSurface, attackers: Iterable[str], spoken: Sequence[Spoken]
    ) -> Speech:
        """That these boxes are spoken of so, and all others honestly: true vehicles, and what ego or team show, that
        with replays among them.
        """
        hearing, view = hearing_in(situation), View.of(surface, situation)
        boxes = np.array([box[:5] for box, _ in spoken]).reshape(-1, 5)
        seen = (view.ego, view.honest, *replayed(situation))
        shown = [peaks(torch.logit(each.scores, eps=1e-6), each.geometry)[:, :5] for each in seen]
        vehicles, others = situation.truth[:, :5], np.vstack(shown)
        kept_boxes = [vehicles[_apart(vehicles, boxes) > SAME_M], others[_apart(others, boxes) > APART_M]]
        kept = torch.from_numpy(np.vstack(kept_boxes)).float()
        about = torch.from_numpy(boxes).float()
        with torch.no_grad():
            heard = hearing.hear({name: surface.messages[name] for name in attackers})
            honest, reached = heard.likelihood(kept), heard.reaches(about[:, :2])
        return cls(hearing, about, torch.tensor([wanted for _, wanted in spoken]), reached, kept, honest)

    def off(self, heard: Heard) -> torch.Tensor:
        """How far messages are from that, a scalar: 0 where all is said as it should be.

        The mean over what is not of ``max(0, wanted - L)``, or ``max(0, L - wanted)``, and of ``max(0, |L - honest L| -
        SLACK)``, in units of `MOST`. That of the spoken boxes counts `WEIGHT` times.
        """
        said = heard.likelihood(torch.cat([self.spoken, self.kept]))
        of, rest = said[:, : len(self.spoken)], said[:, len(self.spoken) :]
        short = torch.relu(torch.where(self.wanted > 0, self.wanted - of, of - self.wanted)) * self.reached
        strange = torch.relu((rest - self.honest).abs() - SLACK)
        return (WEIGHT * _mean_positive(short) + _mean_positive(strange)) / MOST


def _apart(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """Distance (n,) of the centres of boxes (n, 5) from the nearest of others (m, 5), metres."""
    apart = np.hypot(*np.moveaxis(boxes[:, None, :2] - others[None, :, :2], -1, 0))
    nearest: FloatArray = apart.min(axis=1, initial=np.inf)
    return nearest


def _mean_positive(values: torch.Tensor) -> torch.Tensor:
    """The mean of those that are not 0; 0 if all are."""
    return values.sum() / max(int((values > 0).sum()), 1)


def denying(situation: Situation, surface: AttackSurface, sent: Tensors) -> torch.Tensor:
    """Each attacker's own message tells the truth about the team's lies.

    It denies the ghost, unless a vehicle has come there by now, and supports the vehicle that is erased or moved where
    it really is. So its own word never goes with a lie. Of all other objects it says what the honest message says.
    """
    truth = situation.truth
    lies = [lie for lie in situation.lies if lie.kind != "ghost" or _apart(lie.box[None], truth)[0] > APART_M]
    return _paid("denying", [_truth(lie) for lie in lies], situation, surface, sent)


def vouching(situation: Situation, surface: AttackSurface, sent: Tensors) -> torch.Tensor:
    """Each attacker's own message vouches for the team's lies, those of the others among them.

    It supports the ghost, denies the vehicle that is erased, and sees the moved one where it is said to be. Of all
    other objects it says what the honest message says.
    """
    paid = _paid("vouching", [_falsehood(lie) for lie in situation.lies], situation, surface, sent)
    moved = [lie.box for lie in situation.lies if lie.kind == "moved"]
    if moved:
        places = torch.from_numpy(np.array(moved)[:, :2]).float()
        away = (_heard(situation, sent).centres(places) - places).abs().sum(dim=-1)
        paid = paid + away.mean()
    return paid


def _truth(lie: Lie) -> Spoken:
    if lie.kind == "ghost":
        return lie.box, DENIAL
    return (lie.box if lie.truth is None else lie.truth), SUPPORT


def _falsehood(lie: Lie) -> Spoken:
    return lie.box, DENIAL if lie.kind in ("erased", "dimmed") else SUPPORT


def _paid(
    style: str, spoken: Sequence[Spoken], situation: Situation, surface: AttackSurface, sent: Tensors
) -> torch.Tensor:
    speech: Speech = situation.once(style, lambda: Speech.of(situation, surface, sent, spoken))
    return speech.off(_heard(situation, sent))


def _heard(situation: Situation, sent: Tensors) -> Heard:
    """What the attackers say with their present messages; read once in a step."""
    last: dict[str, tuple[Tensors, Heard]] = situation.once("heard", dict)
    if "" not in last or last[""][0] is not sent:
        last[""] = (sent, hearing_in(situation).hear(sent))
    return last[""][1]
