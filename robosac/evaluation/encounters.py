"""Test sequences as one ego meets them under a campaign; the same ones whoever asks, in whatever order."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robosac.attacks import BEHAVIOURS, HONEST, load_campaign
from robosac.attacks.campaign import SEPARATOR
from robosac.boxes import FloatArray
from robosac.detectors import Detector, DetectorInfo, Message, PreparedFrame
from robosac.evaluation.frames import EvaluationFrame, encode_all, misplaced, under_attack
from robosac.scenes import IntersectionScene

EGO = "car-1"
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
    acting = (tuple(schedule.acting(index, sorted(attackers))) for index in range(frames))
    return [Act(attack, names) if names else NOBODY_ACTS for names in acting]


def _unscheduled(campaign: str) -> str:
    """The campaign without those behaviours that only say when who acts."""
    attack, *behaviours = campaign.split(SEPARATOR)
    plain = load_campaign(attack)
    kept = [name for name in behaviours if BEHAVIOURS[name](plain).schedule is plain.schedule]
    return SEPARATOR.join([attack, *kept])


class Encounters:
    """Frames of test sequences as `EGO` meets them.

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
        self._scene: int | None = None
        self._sensed: list[tuple[dict[str, Message], FloatArray]] = []

    def met(self, scene: int, frames: int, act: Act, indices: Sequence[int]) -> Iterator[EvaluationFrame]:
        """Frames of a sequence in all of which the same is done.

        Parameters
        ----------
        scene : int
            Its seed. What was sensed in it is held until the next one is asked for.
        frames : int
            Of the sequence, at 5 Hz.
        act : Act
        indices : sequence of int
            Numbers of the frames.
        """
        self._sense(scene, frames)
        campaign = load_campaign(act.attack)
        stream = zlib.crc32(repr(tuple(act)).encode())
        for index in indices:
            messages, truth = self._sensed[index]
            rng = np.random.default_rng([self._seed, _ATTACK, scene, index, stream])
            yield under_attack(self._detector, messages, truth, EGO, act.acting, campaign, rng, index)

    def _sense(self, scene: int, frames: int) -> None:
        if scene == self._scene and len(self._sensed) >= frames:
            return
        self._scene, self._sensed = scene, []
        for index, frame in enumerate(IntersectionScene(scene).frames(frames)):
            poses = np.random.default_rng([scene, _POSES, index])
            messages = {
                name: message if name == EGO else misplaced(message, self._pose_error_m, poses)
                for name, message in encode_all(self._detector, frame).items()
            }
            self._sensed.append((messages, frame.truth(EGO)))


@dataclass(frozen=True)
class LiveFrame:
    """A test frame that is decoded by the detector itself, whenever it is asked."""

    detector: Detector
    met: EvaluationFrame

    @property
    def info(self) -> DetectorInfo:
        """The detector's."""
        return self.detector.info

    @property
    def ego(self) -> Message:
        """The ego's message."""
        return self.met.ego

    @property
    def teammates(self) -> Mapping[str, Message]:
        """The teammates' messages, as received."""
        return self.met.received

    @property
    def team(self) -> tuple[str, ...]:
        """Teammates, sorted."""
        return tuple(sorted(self.met.received))

    @property
    def attackers(self) -> frozenset[str]:
        """Those whose message of this frame is not honest."""
        return self.met.attackers

    @property
    def truth(self) -> FloatArray:
        """True boxes (G, 5), ego frame."""
        return self.met.truth

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:
        """As the detector does."""
        return self.detector.prepare(ego, teammates)


class Live:
    """Test sequences of which nothing is decoded in advance; parameters as those of `Encounters`."""

    def __init__(self, detector: Detector, *, seed: int = 0, pose_error_m: float = 0.0) -> None:
        self._detector = detector
        self._encounters = Encounters(detector, seed=seed, pose_error_m=pose_error_m)

    def sequence(
        self,
        scene: int,
        frames: int,
        campaign: str = HONEST,
        attackers: Collection[str] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> list[LiveFrame]:
        """A scene's first frames, as `robosac.evaluation.recordings.Recordings.sequence` has them."""
        chosen = acts(campaign, attackers, frames)
        sequence: dict[int, LiveFrame] = {}
        for act in dict.fromkeys(chosen):
            indices = [index for index, other in enumerate(chosen) if other == act]
            for index, met in zip(indices, self._encounters.met(scene, frames, act, indices), strict=True):
                sequence[index] = LiveFrame(self._detector, met)
                tick()
        return [sequence[index] for index in range(frames)]
