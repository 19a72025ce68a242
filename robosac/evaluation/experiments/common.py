"""What the experiments share: scale, scenes, and frames of which each subset is decoded once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robosac.attacks import PGD, Attack
from robosac.boxes import FloatArray
from robosac.detectors import Detector
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import DecodedOnce, Sensed, evaluation_frames, under_attack
from robosac.scenes import Scene, SceneSource, first_scenes

TEAM_SIZE = 5
Tick = Callable[[], None]


@dataclass(frozen=True)
class Scale:
    """How much of everything is run."""

    scenes: int
    frames_per_scene: int
    """Frames 1 s apart, for experiments that judge frames one by one."""
    sequences: int
    sequence_frames: int
    """At 5 Hz, for experiments with memory."""
    repeats: int
    """Runs of whatever draws at random on the same frames."""
    oracle_runs: int
    """Simulated frames of a perfect oracle."""


FULL = Scale(scenes=40, frames_per_scene=5, sequences=10, sequence_frames=25, repeats=10, oracle_runs=4000)
QUICK = Scale(scenes=6, frames_per_scene=2, sequences=2, sequence_frames=12, repeats=4, oracle_runs=500)


@dataclass
class Context:
    """What an experiment works with."""

    scale: Scale
    seed: int
    out: Path
    """Where pictures go."""
    detector: Detector
    hardened: Detector | None
    """The same after adversarial training."""
    data: SceneSource
    """Of scenes with `TEAM_SIZE` teammates."""
    progress: Callable[[str, int], Tick]
    """Given a label and a number of steps, returns what to call after each."""
    _frames: dict[tuple[str, int, int], list[DecodedOnce]] = field(default_factory=dict)

    def scenes(self, count: int, frames: int = 1) -> list[Scene]:
        """The first test scenes.

        Raises
        ------
        SceneError
            If there are not so many with so many frames and a whole team.
        """
        return first_scenes(self.data, "test", count, frames, TEAM_SIZE)

    def rng(self, *stream: int) -> np.random.Generator:
        """A generator of its own for each purpose."""
        return np.random.default_rng([self.seed, *stream])

    def frames(self, attackers: int = 1, attack: Attack | None = None, scenes: int | None = None) -> list[DecodedOnce]:
        """Test frames under an attack (PGD by default) on the detector; kept for later experiments."""
        attack = attack or PGD()
        scenes = scenes or self.scale.scenes
        key = (repr((attack.name, attack)), attackers, scenes)
        if key not in self._frames:
            self._frames[key] = list(self.attacked_frames(self.detector, attackers, attack, scenes))
        return self._frames[key]

    def attacked_frames(self, detector: Detector, attackers: int, attack: Attack, scenes: int) -> Iterator[DecodedOnce]:
        """Test frames under an attack on a detector; the same scenes, egos and attackers for the same numbers."""
        tick = self.progress(f"{attackers} x {attack.name}", scenes * self.scale.frames_per_scene)
        rng, each = self.rng(1, attackers), self.scale.frames_per_scene
        for frame in evaluation_frames(detector, self.scenes(scenes), each, attack, attackers, rng, TEAM_SIZE):
            tick()
            if frame is not None:
                yield DecodedOnce.of(frame)

    def sequence(self, number: int, attackers: int = 1) -> list[DecodedOnce]:
        """A test sequence under PGD: the first ego of the scene meets the same attackers in all frames."""
        key = ("sequence", attackers, number)
        if key not in self._frames:
            scene = self.scenes(number + 1, self.scale.sequence_frames)[number]
            ego = scene.egos[0]
            rng = self.rng(2, number)
            teammates = sorted(set(scene.agents) - {ego})
            chosen = [teammates[i] for i in rng.choice(len(teammates), attackers, replace=False)]
            tick = self.progress(f"sequence {number}, {attackers} x pgd", self.scale.sequence_frames)
            self._frames[key] = []
            for index in range(self.scale.sequence_frames):
                sensed = Sensed.of(self.detector, scene.frame(index), ego, 0.0, rng)
                met = under_attack(self.detector, sensed, chosen, PGD(), rng)
                self._frames[key].append(DecodedOnce.of(met))
                tick()
        return self._frames[key]


def precision(answers: Iterator[tuple[FloatArray, FloatArray]]) -> tuple[float, float]:
    """AP at IoU 0.5 and 0.7 of pairs of boxes and truth."""
    ap = AveragePrecision()
    for boxes, truth in answers:
        ap.add(boxes, truth)
    return ap.at(0.5), ap.at(0.7)
