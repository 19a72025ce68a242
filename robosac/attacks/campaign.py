"""What an adversary does over a sequence: which attackers act in which frame, with which attack, under which pretence.

A campaign is written ``attack@behaviour@behaviour``: a name of `robosac.attacks.ATTACKS` (or ``module:callable``, or
``honest``) and names of `BEHAVIOURS`, as in ``erase@asleep`` or ``honest@false-pose``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians
from typing import Protocol

import numpy as np

from robosac.attacks.alibi import Alibi, Covering, Framing, with_alibi
from robosac.attacks.base import Attack, IterativeAttack
from robosac.attacks.geometric import SHOWN
from robosac.boxes import FloatArray, pose_matrix
from robosac.detectors.base import Detector, Encoder, GeometricSurface, Message, Preparer, blank
from robosac.plugins import lacks

SEPARATOR = "@"
HONEST = "honest"
_FLICKER = 51


class Schedule(Protocol):
    """Which attackers act in a frame; a pure function of its number, so that all egos of a frame meet the same."""

    def acting(self, frame: int, attackers: Sequence[str]) -> Sequence[str]:
        """Those of the attackers that act; the others send honest messages."""
        ...


@dataclass(frozen=True)
class Always:
    """All attackers in every frame."""

    def acting(self, frame: int, attackers: Sequence[str]) -> Sequence[str]:  # noqa: ARG002
        """All of them."""
        return attackers


@dataclass(frozen=True)
class Asleep:
    """Honest for the first frames, so as to earn trust; then all attackers in every frame."""

    frames: int = 10

    def acting(self, frame: int, attackers: Sequence[str]) -> Sequence[str]:
        """Nobody before the frame of that number."""
        return attackers if frame >= self.frames else ()


@dataclass(frozen=True)
class Flicker:
    """All attackers in a random share of the frames; nobody in the others.

    Attributes
    ----------
    share : float
        In [0, 1].
    seed : int
        The same seed and frame give the same draw.
    """

    share: float = 0.2
    seed: int = 0

    def acting(self, frame: int, attackers: Sequence[str]) -> Sequence[str]:
        """All or nobody."""
        struck = np.random.default_rng([_FLICKER, self.seed, frame]).random() < self.share
        return attackers if struck else ()


@dataclass(frozen=True)
class Turns:
    """One attacker at a time, for so many frames each: those that wait behave, and so clear themselves."""

    frames: int = 5

    def acting(self, frame: int, attackers: Sequence[str]) -> Sequence[str]:
        """The one whose turn it is."""
        if not attackers:
            return ()
        return (attackers[frame // self.frames % len(attackers)],)


@dataclass(frozen=True)
class FalsePose:
    """A lie about one's own pose: the ego puts the message in a wrong place.

    Attributes
    ----------
    forward_m, left_m : float
        Where the claimed pose lies from the true one, along the sender's axes.
    turn_deg : float
        By how much it is turned, counter-clockwise.
    """

    forward_m: float = 0.8
    left_m: float = 0.6
    turn_deg: float = 3.0

    def claimed(self, pose: FloatArray) -> FloatArray:
        """The claimed world_from_sensor (4, 4) for the true one."""
        return pose @ pose_matrix(self.forward_m, self.left_m, 0.0, radians(self.turn_deg))


@dataclass(frozen=True)
class Campaign:
    """An attack over a sequence of frames.

    Parameters
    ----------
    attack : Attack, optional
        None sends honest tensors: the lie, if any, is in the pose.
    schedule : Schedule
    pose : FalsePose, optional
        Acting attackers claim this pose; the attack is optimised for the fusion that it leads to.
    alibi : Alibi, optional
        Fusions in which the attack behaves; for iterative attacks.

    Raises
    ------
    ValueError
        If there is an alibi for an attack that does not optimise.
    """

    attack: Attack | None
    schedule: Schedule = Always()
    pose: FalsePose | None = None
    alibi: Alibi | None = None

    def __post_init__(self) -> None:
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
    def epsilon(self) -> float:
        """The attack's bound; 0 where the tensors are honest."""
        return self.attack.epsilon if self.attack is not None else 0.0

    @property
    def needs(self) -> tuple[str, ...]:
        """What the attack and its alibi call of an attack surface; see `Attack.needs`."""
        return (*(self.attack.needs if self.attack is not None else ()), *(SHOWN if self.alibi is not None else ()))

    def messages(
        self,
        detector: Detector,
        ego: Message,
        benign: Mapping[str, Message],
        attackers: Collection[str],
        frame: int,
        rng: np.random.Generator,
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

        Raises
        ------
        KeyError
            If an attacker has no message in the frame.
        NoGeometry
            If the attack or its alibi needs boxes that the detector does not show.
        """
        acting = list(self.schedule.acting(frame, sorted(attackers)))
        if not acting or (self.attack is None and self.pose is None):
            return {}
        sent = {name: benign[name] for name in acting}
        if self.pose is not None:
            sent = {name: replace(message, pose=self.pose.claimed(message.pose)) for name, message in sent.items()}
        if self.attack is None:
            return sent
        surface = detector.attack_surface(ego, {**benign, **sent})
        if self.alibi is not None and isinstance(self.attack, IterativeAttack):
            clean = {name: surface.messages[name] for name in acting}
            aim = with_alibi(self.attack, self.alibi, surface, acting)
            tensors = self.attack.descend(aim, clean, rng)
        else:
            tensors = self.attack.run(surface, acting, rng)
        return {name: detector.perturbed(sent[name], tensor) for name, tensor in tensors.items()}


def lacking(attack: Attack | Campaign | None, detector: Preparer) -> str | None:
    """Say what a detector lacks for scenes with an attack, before work begins.

    Parameters
    ----------
    attack : Attack, Campaign or None
        None for scenes without an attack.
    detector : Preparer
        Its attack surface is looked at in a frame of zeros.

    Returns
    -------
    str or None
        A sentence with each missing method and what it is for; None if nothing is missing.
    """
    campaign = Campaign.of(attack)
    name = detector.info.name
    if missing := lacks(detector, Encoder if campaign.attack is None else Detector):
        return f"the detector {name} cannot be used in scenes with the attack {campaign.name!r}: it {missing}"
    if campaign.attack is None or not isinstance(detector, Detector):
        return None
    surface = detector.attack_surface(blank(detector.info, "ego"), {"a": blank(detector.info, "teammate")})
    missing = lacks(surface, GeometricSurface, dict.fromkeys(campaign.needs))
    return f"{campaign.name} cannot attack the detector {name}: its attack surface {missing}" if missing else None


BEHAVIOURS: dict[str, Callable[[Campaign], Campaign]] = {
    "asleep": lambda campaign: replace(campaign, schedule=Asleep()),
    "flicker": lambda campaign: replace(campaign, schedule=Flicker()),
    "turns": lambda campaign: replace(campaign, schedule=Turns()),
    "covering": lambda campaign: replace(campaign, alibi=Covering()),
    "framing": lambda campaign: replace(campaign, alibi=Framing()),
    "false-pose": lambda campaign: replace(campaign, pose=FalsePose()),
}
"""All behaviours by name: each takes a campaign and gives the one that also behaves so."""
