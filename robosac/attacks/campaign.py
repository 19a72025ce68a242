"""What an adversary does over a sequence: which attackers act in which frame, with which attack, under which pretence.

A campaign is written ``attack@behaviour@behaviour``: a name of `robosac.attacks.ATTACKS` (or ``module:callable``, or
``honest``) and names of `BEHAVIOURS`, as in ``erase@asleep`` or ``honest@false-pose``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians
from typing import Any

import numpy as np
import torch

from robosac.attacks import penalties, words
from robosac.attacks.alibi import Alibi, covering, framing, keeping
from robosac.attacks.base import Attack, IterativeAttack, Tensors, Term
from robosac.attacks.geometric import SHOWN
from robosac.attacks.hearing import Hearing
from robosac.attacks.returned import check_returned, check_sent, of_attackers
from robosac.attacks.situation import Past, Situation
from robosac.boxes import FloatArray, pose_matrix
from robosac.detectors.base import (
    AttackSurface,
    Detector,
    DetectorError,
    Message,
    misfit,
)

SEPARATOR = "@"
HONEST = "honest"
SOFT_STEPS, SOFT_STEP = 30, 0.04
_FLICKER = 51


Schedule = Callable[[int, Sequence[str]], Sequence[str]]
"""Of the number of a frame and all attackers, those that act; the others send honest messages. All egos of a frame meet
the same ones.
"""
Pretence = Callable[[FloatArray, int], FloatArray]
"""Of one's true pose, and the frame's number, the claimed pose: world_from_sensor (4, 4), both."""


def always(frame: int, attackers: Sequence[str]) -> Sequence[str]:  # noqa: ARG001
    """All attackers in every frame."""
    return attackers


def asleep(frame: int, attackers: Sequence[str], frames: int = 10) -> Sequence[str]:
    """Nobody in the first frames, so as to earn trust; then all attackers in every frame."""
    return attackers if frame >= frames else ()


def flicker(frame: int, attackers: Sequence[str], share: float = 0.2, seed: int = 0) -> Sequence[str]:
    """All attackers in a random share of the frames, in [0, 1]; nobody in the others."""
    return attackers if np.random.default_rng([_FLICKER, seed, frame]).random() < share else ()


def turns(frame: int, attackers: Sequence[str], frames: int = 5) -> Sequence[str]:
    """One attacker at a time, for so many frames each: those that wait behave, and so clear themselves."""
    return (attackers[frame // frames % len(attackers)],) if attackers else ()


def false_pose(
    pose: FloatArray,
    frame: int,  # noqa: ARG001
    forward_m: float = 0.8,
    left_m: float = 0.6,
    turn_deg: float = 3.0,
) -> FloatArray:
    """A pose that lies so far from the true one along the sender's axes, turned counter-clockwise: the ego puts the
    message in a wrong place.
    """
    return pose @ pose_matrix(forward_m, left_m, 0.0, radians(turn_deg))


def turning_pose(pose: FloatArray, frame: int, turn_deg: float = 0.15, most_deg: float = 3.0) -> FloatArray:
    """A pose that turns counter-clockwise, by so much more in each frame, as far as so much."""
    return pose @ pose_matrix(0.0, 0.0, 0.0, radians(min(frame * turn_deg, most_deg)))


def drifting_pose(pose: FloatArray, frame: int, left_m: float = 0.1, most_m: float = 1.2) -> FloatArray:
    """A pose that drifts to the sender's left, by so much more in each frame, as far as so much."""
    return pose @ pose_matrix(0.0, min(frame * left_m, most_m), 0.0, 0.0)


@dataclass(frozen=True)
class Campaign:
    """An attack over a sequence of frames.

    Raises
    ------
    ValueError
        If the attack has no name, or there is an alibi for one that does not optimise.
    """

    attack: Attack | None
    """None sends honest tensors: the lie, if any, is in the pose."""
    schedule: Schedule = always
    pose: Pretence | None = None
    """Of the acting attackers; the attack is optimised for the fusion that it leads to."""
    alibi: Alibi | None = None
    """Fusions in which the attack behaves; for iterative attacks."""
    softness: float = 0.0
    """Weight of the sum of `robosac.attacks.penalties.PENALTIES`; for iterative attacks. Such an attack remembers, and
    takes at least `SOFT_STEPS` steps of at most `SOFT_STEP`, since larger ones shake the boxes by themselves.
    """
    words: penalties.Penalty | None = None
    """What the attackers' own messages are made to say, for attacks that are soft: one more penalty of that weight
    (`robosac.attacks.words`). It needs a detector with a witness.
    """
    bound: float = 1.0
    """So many times the attack's own bound."""

    def __post_init__(self) -> None:
        if self.attack is not None and not isinstance(getattr(self.attack, "name", None), str):
            raise ValueError(f"{type(self.attack).__name__} has no name: give the class a text, such as name = 'mine'")
        if self.softness and not isinstance(self.attack, IterativeAttack):
            raise ValueError(f"only an attack that optimises can be soft, not {self.name}")
        if self.words is not None and not self.softness:
            raise ValueError("only an attack that is soft pays for words")
        if self.bound != 1.0 and not self._bounded:
            unless = " unless it has an alibi or is soft" if isinstance(self.attack, IterativeAttack) else ""
            raise ValueError(f"only an attack with a bound can have another one, not {self.name}{unless}")
        if self.alibi is not None and not isinstance(self.attack, IterativeAttack):
            raise ValueError(f"only an attack that optimises can have an alibi, not {self.name}")

    @classmethod
    def of(cls, attack: Attack | Campaign | None) -> Campaign:
        """The campaign itself, or the attack in every frame; without one, everybody is honest."""
        return attack if isinstance(attack, Campaign) else cls(attack)

    @property
    def name(self) -> str:
        """The attack's."""
        return self.attack.name if self.attack is not None else HONEST

    @property
    def _pretends(self) -> bool:
        return bool(self.softness) or self.alibi is not None

    @property
    def _bounded(self) -> bool:
        return self.attack is not None and (self.attack.bounded or self._pretends)

    @property
    def epsilon(self) -> float:
        """The bound on the perturbation; 0 where the tensors are honest."""
        return self.bound * self.attack.epsilon if self.attack is not None else 0.0

    @property
    def remembers(self) -> bool:
        """Whether what it does in a frame depends on earlier ones; see `Attack.remembers`."""
        return bool(self.softness) or (self.attack is not None and self.attack.remembers)

    @property
    def hears(self) -> bool:
        """Whether it reads what each message says by itself; see `Attack.hears`."""
        return self.words is not None or (self.attack is not None and self.attack.hears)

    @property
    def needs(self) -> tuple[str, ...]:
        """What the attack, its alibi and penalties call of an attack surface; see `Attack.needs`."""
        needs = self.attack.needs if self.attack is not None else ()
        return (*needs, *SHOWN) if self._pretends else needs

    def messages(
        self,
        detector: Detector,
        ego: Message,
        benign: Mapping[str, Message],
        attackers: Collection[str],
        frame: int,
        rng: np.random.Generator,
        situation: Situation | None = None,
    ) -> dict[str, Message]:
        """What the attackers that act in this frame send to this ego instead of their benign messages.

        Parameters
        ----------
        benign : mapping of teammate to Message
            What all teammates would send if everybody were honest.
        attackers : collection of str
            All under the adversary's control.
        frame : int
            Its number in the sequence.
        situation : Situation, optional
            What else the adversary knows of the frame; by default where everybody is, and no past.

        Raises
        ------
        robosac.attacks.returned.NoSuchAttacker
            A `KeyError`: an attacker has no message in the frame.
        AttackError
            If the attack returns what is no message of an attacker.
        NoGeometry
            If the attack or its alibi needs boxes that the detector does not show.
        NoWitness
            If it needs a witness that the detector does not have.
        DetectorError
            If the detector's ``perturbed`` makes no message of its layout.
        """
        acting = list(self.schedule(frame, sorted(attackers)))
        if not acting or (self.attack is None and self.pose is None):
            return {}
        sent = of_attackers(benign, acting)
        if self.pose is not None:
            sent = {name: replace(message, pose=self.pose(message.pose, frame)) for name, message in sent.items()}
        if self.attack is None:
            return sent
        met = {**benign, **sent}
        surface = detector.attack_surface(ego, met)
        known = Past().situation(frame, ego, met, np.empty((0, 5))) if situation is None else situation
        known = replace(
            known,
            poses={name: message.pose for name, message in met.items()},
            tensor=lambda message: detector.attack_surface(ego, {"": message}).messages[""],
        )
        if self.hears:
            known = replace(known, hearing=Hearing.of(detector.info, ego, surface.messages, known.poses))
        tensors = self._attacked(surface, acting, rng, known)
        check_returned(self.name, tensors, surface, acting)
        with np.errstate(over="ignore"):  # what is too large is told below
            attacking = {name: detector.perturbed(sent[name], tensor) for name, tensor in tensors.items()}
        for message in attacking.values():
            if fault := misfit(message, detector.info):
                raise DetectorError(f"{detector.info.name}: perturbed must return {fault}")
        check_sent(self.name, attacking, known.lies)
        return {**sent, **attacking} if self.pose is not None else attacking

    def _attacked(
        self, surface: AttackSurface, acting: Sequence[str], rng: np.random.Generator, situation: Situation
    ) -> Mapping[str, torch.Tensor]:
        """The attack's tensors, under the campaign's bound and pretences."""
        if self.attack is None:
            return {}
        attack = self.attack if self.bound == 1.0 else replace(self.attack, epsilon=self.epsilon)
        if not isinstance(attack, IterativeAttack) or not self._pretends:
            return attack.run(surface, acting, rng, situation)
        terms = keeping(self.alibi, surface, acting) if self.alibi is not None else []
        if self.softness:
            attack = replace(attack, steps=max(attack.steps, SOFT_STEPS), step_size=min(attack.step_size, SOFT_STEP))
            terms.append(self._paid(surface, situation))
        sent = attack.optimise(surface, acting, rng, situation, terms, warm=self.remembers)
        if self.softness and sent:
            penalties.remember(situation, surface, sent)
        return sent

    def _paid(self, surface: AttackSurface, situation: Situation) -> Term:
        def paid(sent: Tensors) -> torch.Tensor:
            due = [*penalties.PENALTIES, *([] if self.words is None else [self.words])]
            each = [penalty(situation, surface, sent) for penalty in due]
            return self.softness * torch.stack(each).sum()

        return paid


BEHAVIOURS: Mapping[str, Mapping[str, Any]] = {
    "asleep": {"schedule": asleep},
    "flicker": {"schedule": flicker},
    "turns": {"schedule": turns},
    "covering": {"alibi": covering},
    "framing": {"alibi": framing},
    "false-pose": {"pose": false_pose},
    "turning-pose": {"pose": turning_pose},
    "drifting-pose": {"pose": drifting_pose},
    "soft": {"softness": 1.0},
    "soft3": {"softness": 3.0},
    "denying": {"softness": 1.0, "words": words.denying},
    "vouching": {"softness": 1.0, "words": words.vouching},
    "double": {"bound": 2.0},
}
"""All behaviours by name: what each sets of a `Campaign`."""
