"""Sequences as one ego meets them under a campaign; the same ones whoever asks, in whatever order."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from robosac.attacks import BEHAVIOURS, HONEST, load_campaign
from robosac.attacks.campaign import SEPARATOR
from robosac.attacks.situation import Past
from robosac.detectors import Detector
from robosac.evaluation.frames import EvaluationFrame, Sensed, foreign_views, under_attack
from robosac.scenes import Scene

_POSES = 53
_ATTACK = 54


class Act(NamedTuple):
    """What is done in a frame: an attack, written without its schedule, and by whom."""

    attack: str
    acting: tuple[str, ...]


NOBODY_ACTS = Act(HONEST, ())


def acts(campaign: str, attackers: Collection[str], frames: int) -> list[Act]:
    """What a campaign does in each frame of a sequence."""
    schedule = load_campaign(campaign).schedule
    attack, *behaviours = campaign.split(SEPARATOR)
    attack = SEPARATOR.join([attack, *(name for name in behaviours if "schedule" not in BEHAVIOURS[name])])
    acting = (tuple(schedule(index, sorted(attackers))) for index in range(frames))
    return [Act(attack, names) if names else NOBODY_ACTS for names in acting]


@dataclass
class Encounters:
    """Frames of a scene as its first ego meets them."""

    detector: Detector
    scene: Scene
    seed: int = 0
    """Of attacks."""
    pose_error_m: float = 0.0
    """Standard deviation of the error of each teammate's position along either axis, metres; the same errors whatever
    the attack.
    """
    elsewhere: Scene | None = None
    """Another scene, for attacks that replay what is sensed there."""
    _sensed: dict[int, Sensed] = field(default_factory=dict, init=False)

    def sequence(
        self,
        frames: int,
        campaign: str = HONEST,
        attackers: Collection[str] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> list[EvaluationFrame]:
        """The scene's first frames.

        Parameters
        ----------
        campaign : str
            As `robosac.attacks.load_campaign` takes it.
        attackers : collection of str
            Under the adversary's control.
        tick : callable
            Called after each frame.
        """
        chosen = acts(campaign, attackers, frames)
        sequence: dict[int, EvaluationFrame] = {}
        for act in dict.fromkeys(chosen):
            indices = [index for index, other in enumerate(chosen) if other == act]
            for index, met in zip(indices, self.met(act, indices), strict=True):
                sequence[index] = met
                tick()
        return [sequence[index] for index in range(frames)]

    def met(self, act: Act, indices: Sequence[int]) -> Iterator[EvaluationFrame]:
        """The frames of these numbers, ascending, if this is done in all of them.

        An attack that remembers is run over all frames from the first of the scene on, and only the wanted ones are
        given: so they depend on nothing but the act.
        """
        campaign = load_campaign(act.attack)
        stream = zlib.crc32(repr(tuple(act)).encode())
        wanted, past = set(indices), self._past()
        for index in range(max(wanted, default=-1) + 1) if campaign.remembers else indices:
            rng = np.random.default_rng([self.seed, _ATTACK, self.scene.number, index, stream])
            past = past if campaign.remembers else self._past()
            met = under_attack(self.detector, self._sense(index), act.acting, campaign, rng, past)
            if index in wanted:
                yield met

    def _past(self) -> Past:
        return Past(self.scene.frame_period_s, foreign_views(self.detector, self.elsewhere))

    def _sense(self, index: int) -> Sensed:
        if index not in self._sensed:
            rng = np.random.default_rng([self.scene.number, _POSES, index])
            frame, ego = self.scene.frame(index), self.scene.egos[0]
            self._sensed[index] = Sensed.of(self.detector, frame, ego, self.pose_error_m, rng)
        return self._sensed[index]
