"""What the experiments share: scale, recorded frames, and the pieces of a report."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robosac.attacks import PGD, Attack
from robosac.boxes import FloatArray
from robosac.consensus import at_least
from robosac.detectors import Detector, EmbeddedDetector
from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import DecodedOnce, EvaluationFrame, encode_all, evaluation_frames, under_attack
from robosac.scenes import IntersectionScene
from robosac.scenes.splits import TEST_SEEDS

TEAM_SIZE = 5
Tick = Callable[[], None]


@dataclass(frozen=True)
class Scale:
    """How much of everything is run.

    Attributes
    ----------
    scenes, frames_per_scene : int
        Frames 1 s apart, for experiments that judge frames one by one.
    sequences, sequence_frames : int
        At 5 Hz, for experiments with memory.
    repeats : int
        Runs of whatever draws at random on the same frames.
    oracle_runs : int
        Simulated frames of a perfect oracle.
    """

    scenes: int
    frames_per_scene: int
    sequences: int
    sequence_frames: int
    repeats: int
    oracle_runs: int


FULL = Scale(scenes=40, frames_per_scene=5, sequences=10, sequence_frames=25, repeats=10, oracle_runs=4000)
QUICK = Scale(scenes=6, frames_per_scene=2, sequences=2, sequence_frames=12, repeats=4, oracle_runs=500)


@dataclass(frozen=True)
class Table:
    """A table of a report; cells are strings or numbers, None is empty."""

    name: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True)
class Section:
    """One experiment of a report: what it shows in words, its tables, and the pictures it drew (file names)."""

    title: str
    text: str
    tables: Sequence[Table] = ()
    pictures: Sequence[str] = ()


class Recorded(DecodedOnce):
    """A test frame in which each subset is decoded once, whoever asks."""

    def __init__(self, detector: Detector, frame: EvaluationFrame) -> None:
        super().__init__(detector, frame.ego, frame.received)
        self.frame = frame

    def confident(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset that take part in the consensus test."""
        return at_least(self.detect(teammates), self.info.consensus_score)


@dataclass
class Context:
    """What an experiment works with.

    Attributes
    ----------
    scale : Scale
    seed : int
    out : Path
        Where pictures go.
    progress : callable
        Given a label and a number of steps, returns what to call after each.
    """

    scale: Scale
    seed: int
    out: Path
    progress: Callable[[str, int], Tick]
    _frames: dict[tuple[str, int, int], list[Recorded]] = field(default_factory=dict)

    @cached_property
    def detector(self) -> EmbeddedDetector:
        """The shipped detector."""
        return EmbeddedDetector()

    @cached_property
    def hardened(self) -> EmbeddedDetector:
        """The detector after adversarial training."""
        return EmbeddedDetector(ADVERSARIAL_WEIGHTS)

    def rng(self, *stream: int) -> np.random.Generator:
        """A generator of its own for each purpose."""
        return np.random.default_rng([self.seed, *stream])

    def frames(self, attackers: int = 1, attack: Attack | None = None, scenes: int | None = None) -> list[Recorded]:
        """Recorded test frames under an attack (PGD by default) on the shipped detector; kept for later experiments."""
        attack = attack or PGD()
        scenes = scenes or self.scale.scenes
        key = (repr((attack.name, attack)), attackers, scenes)
        if key not in self._frames:
            self._frames[key] = list(self.attacked_frames(self.detector, attackers, attack, scenes))
        return self._frames[key]

    def attacked_frames(self, detector: Detector, attackers: int, attack: Attack, scenes: int) -> Iterator[Recorded]:
        """Test frames under an attack on a detector; the same scenes, egos and attackers for the same numbers."""
        tick = self.progress(f"{attackers} x {attack.name}", scenes * self.scale.frames_per_scene)
        rng = self.rng(1, attackers)
        frames = evaluation_frames(detector, TEST_SEEDS[:scenes], self.scale.frames_per_scene, attack, attackers, rng)
        for frame in frames:
            yield Recorded(detector, frame)
            tick()

    def sequence(self, number: int, attackers: int = 1) -> list[Recorded]:
        """A test sequence at 5 Hz under PGD: car-1 is the ego, the attackers stay the same."""
        key = ("sequence", attackers, number)
        if key not in self._frames:
            scene = IntersectionScene(TEST_SEEDS[number])
            rng = self.rng(2, number)
            teammates = sorted(set(scene.agents) - {"car-1"})
            chosen = [teammates[i] for i in rng.choice(TEAM_SIZE, attackers, replace=False)]
            tick = self.progress(f"sequence {number}, {attackers} x pgd", self.scale.sequence_frames)
            self._frames[key] = []
            for frame in scene.frames(self.scale.sequence_frames):
                messages = encode_all(self.detector, frame)
                attacked = under_attack(self.detector, messages, frame.truth("car-1"), "car-1", chosen, PGD(), rng)
                self._frames[key].append(Recorded(self.detector, attacked))
                tick()
        return self._frames[key]


def precision(answers: Iterator[tuple[FloatArray, FloatArray]]) -> tuple[float, float]:
    """AP at IoU 0.5 and 0.7 of pairs of boxes and truth."""
    ap = AveragePrecision()
    for boxes, truth in answers:
        ap.add(boxes, truth)
    return ap.at(0.5), ap.at(0.7)
