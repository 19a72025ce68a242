"""Replays: true maps of another time, place or sender.

They optimise nothing, and keep to no bound, unless they have something to pretend (`robosac.attacks.campaign`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from robosac.attacks.base import Aim, IterativeAttack
from robosac.attacks.geometric import Perception, unnoticed
from robosac.attacks.returned import of_attackers
from robosac.attacks.situation import Situation
from robosac.detectors.base import AttackSurface, Message

STALE_S = 1.0
"""Age of the map that `Stale` sends, seconds."""
_FIRST = "first"
_REPLAYED = "replayed"


@dataclass(frozen=True)
class Heard:
    """What a map can be taken from."""

    messages: Mapping[str, torch.Tensor]
    """By teammate: the benign ones of this frame."""
    attackers: Collection[str]
    situation: Situation

    def shown(self, message: Message | None) -> torch.Tensor | None:
        """A message in the form of `messages`."""
        tensor = self.situation.tensor
        return None if message is None or tensor is None else tensor(message)


@dataclass(frozen=True)
class Replay(IterativeAttack):
    """Each attacker sends a map that is not of this frame and view, under its own present pose.

    An attacker that has none to send is honest. By itself a replay is that map, and the parameters say nothing. With an
    alibi or penalties (`robosac.attacks.Campaign`) it is optimised for them, within ``epsilon`` of that map. What it
    minimises besides is how far the fusion of the whole team is from the one with that map (`unnoticed`). So its harm
    stays.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    remembers: ClassVar[bool] = True
    bounded: ClassVar[bool] = False

    steps: int = 30
    step_size: float = 0.04

    @abstractmethod
    def replayed(self, name: str, heard: Heard) -> torch.Tensor | None:
        """What an attacker sends, in the form of its benign message; None if it has nothing."""

    def run(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,  # noqa: ARG002
        situation: Situation | None = None,
    ) -> dict[str, torch.Tensor]:
        """Look each attacker's map up."""
        return self.around(surface, attackers, situation or Situation())

    def around(
        self, surface: AttackSurface, attackers: Collection[str], situation: Situation
    ) -> dict[str, torch.Tensor]:
        """The maps themselves."""
        heard, sent = Heard(surface.messages, attackers, situation), {}
        for name, own in of_attackers(surface.messages, attackers).items():
            found = self.replayed(name, heard)
            if found is not None and found.shape == own.shape and not torch.equal(found, own):
                sent[name] = found
        return sent

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:
        """The fusion of the whole team as it is under the replays."""
        maps = self.around(surface, attackers, situation)
        (shown,) = situation.once(_REPLAYED, lambda: (Perception.of(surface, surface.messages, maps),))
        return lambda sent, delta: unnoticed(surface, surface.messages, sent, shown)  # noqa: ARG005


def replayed(situation: Situation) -> tuple[Perception, ...]:
    """What the ego makes of all messages while they hold replays as they are; nothing if the attack is none."""
    shown: tuple[Perception, ...] = situation.once(_REPLAYED, tuple)
    return shown


@dataclass(frozen=True)
class Frozen(Replay):
    """Its own first map, for ever."""

    name: ClassVar[str] = "frozen"

    def replayed(self, name: str, heard: Heard) -> torch.Tensor | None:
        """The first that it had."""
        first: dict[str, torch.Tensor] = heard.situation.memory.setdefault(_FIRST, {})
        return first.setdefault(name, heard.messages[name].clone())


@dataclass(frozen=True)
class Stale(Replay):
    """Its own map of one second ago; before it has one, the oldest that it has."""

    name: ClassVar[str] = "stale"

    def replayed(self, name: str, heard: Heard) -> torch.Tensor | None:
        """That of the right age."""
        situation = heard.situation
        then = situation.frame - max(1, round(STALE_S / situation.period_s))
        since = [n for n, messages in situation.earlier.items() if n >= then and name in messages]
        return heard.shown(situation.earlier[min(since)][name]) if since else None


@dataclass(frozen=True)
class Elsewhere(Replay):
    """What the same agent senses in another scene."""

    name: ClassVar[str] = "elsewhere"

    def replayed(self, name: str, heard: Heard) -> torch.Tensor | None:
        """That of the same frame there."""
        foreign = heard.situation.foreign
        return None if foreign is None else heard.shown(foreign(name, heard.situation.frame))


@dataclass(frozen=True)
class Copy(Replay):
    """Another teammate's present map, as if it were its own: that of the next honest one by name."""

    name: ClassVar[str] = "copy"

    def replayed(self, name: str, heard: Heard) -> torch.Tensor | None:
        """The next one's."""
        honest = sorted(set(heard.messages) - set(heard.attackers))
        after = [other for other in honest if other > name]
        return heard.messages[(after or honest)[0]] if honest else None
