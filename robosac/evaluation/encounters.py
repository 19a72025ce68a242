"""Sequences as one ego meets them under a campaign; the same ones whoever asks, in whatever order."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from robosac.attacks import BEHAVIOURS, HONEST, load_campaign
from robosac.attacks.campaign import SEPARATOR
from robosac.detectors import Detector
from robosac.evaluation.frames import EvaluationFrame, Sensed, under_attack
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
    attack = _unscheduled(campaign)
    acting = (tuple(schedule(index, sorted(attackers))) for index in range(frames))
    return [Act(attack, names) if names else NOBODY_ACTS for names in acting]


def _unscheduled(campaign: str) -> str:
    """The campaign without those behaviours that only say when who acts."""
    attack, *behaviours = campaign.split(SEPARATOR)
    return SEPARATOR.join([attack, *(name for name in behaviours if "schedule" not in BEHAVIOURS[name])])


class Encounters:
    """Frames of sequences as the first ego of a scene meets them.

    Parameters
    ----------
    detector : Detector
    seed : int
        Of attacks.
    pose_error_m : float
        Standard deviation of the error of each teammate's position along either axis, metres; the same errors whatever
        the attack.
    """

    def __init__(self, detector: Detector, *, seed: int = 0, pose_error_m: float = 0.0) -> None:
        self._detector = detector
        self._seed = seed
        self._pose_error_m = pose_error_m
        self._scene: Scene | None = None
        self._sensed: list[Sensed] = []

    def sequence(
        self,
        scene: Scene,
        frames: int,
        campaign: str = HONEST,
        attackers: Collection[str] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> list[EvaluationFrame]:
        """A scene's first frames; nothing of them is decoded yet.

        Parameters
        ----------
        scene : Scene
        frames : int
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
            for index, met in zip(indices, self.met(scene, frames, act, indices), strict=True):
                sequence[index] = met
                tick()
        return [sequence[index] for index in range(frames)]

    def met(self, scene: Scene, frames: int, act: Act, indices: Sequence[int]) -> Iterator[EvaluationFrame]:
        """Those frames of a sequence that have these numbers, if the same is done in all of them.

        What was sensed in a scene is held until the next scene is asked for.
        """
        self._sense(scene, frames)
        campaign = load_campaign(act.attack)
        stream = zlib.crc32(repr(tuple(act)).encode())
        for index in indices:
            rng = np.random.default_rng([self._seed, _ATTACK, scene.number, index, stream])
            yield under_attack(self._detector, self._sensed[index], act.acting, campaign, rng)

    def _sense(self, scene: Scene, frames: int) -> None:
        if scene == self._scene and len(self._sensed) >= frames:
            return
        self._scene, self._sensed = scene, []
        for index in range(frames):
            rng = np.random.default_rng([scene.number, _POSES, index])
            frame = scene.frame(index)
            self._sensed.append(Sensed.of(self._detector, frame, scene.egos[0], self._pose_error_m, rng))
