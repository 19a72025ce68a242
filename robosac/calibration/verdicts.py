"""Verdicts on validation frames: what tests say when it is known who attacks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

from robosac.attacks import Attack
from robosac.attacks.situation import Past
from robosac.boxes import FloatArray
from robosac.consensus import at_least
from robosac.defenses.group_testing.geometry import changes, crowd, followed, measure
from robosac.defenses.group_testing.model import CHANGE_SIZES, change_bin, crowd_bin, pair_bin, size_row
from robosac.detectors import Detector
from robosac.evaluation.frames import DecodedOnce, Sensed, Subset, foreign_views, under_attack
from robosac.evaluation.recordings import record, subsets
from robosac.scenes import Scene, whose_turn

STRETCH_STRIDE = 10
"""Stretches of a scene begin this many frames apart, so that they differ."""
STRETCH = 2
"""Successive frames of a stretch."""
Stretch = tuple[str | None, list[DecodedOnce]]
"""A kind of attack (None: nobody attacks), and successive frames, recorded."""
ADDED_BOXES = 1.0
"""A benign teammate is complementary if it adds so many boxes, on average, to fusions of up to two others."""
PairKey = tuple[str | None, int, int, int]
"""Kind of attack (None: nobody attacks in the pair), cell, row of `SIZES`, bin.

Cells of a kind: 1 if only in d somebody attacks, 2 if only in a, 3 if in both. Without an attack the cells say so of
those that are complementary, and 0 is for all pairs, whoever is.
"""
ChangeKey = tuple[str | None, int, int, int]
"""Kind of attack (None: nobody attacks in the fusion), index of its size, bin of its boxes, bin of its changes."""


@dataclass
class Verdicts:
    """Counts of what was observed, by what was true."""

    pairs: Counter[PairKey] = field(default_factory=Counter)
    changes: Counter[ChangeKey] = field(default_factory=Counter)
    team: int = 0
    """Teammates of the largest team."""

    def add_stretch(self, stretch: Sequence[DecodedOnce], kind: str | None) -> None:
        """Count what successive frames show, each by itself and from one to the next; the same ones attack in all."""
        for frame in stretch:
            self.add(frame, kind)
        for before, frame in pairwise(stretch):
            for subset in subsets(frame.team)[1:]:
                if subset not in before.boxes or (kind is not None and subset.isdisjoint(frame.attackers)):
                    continue
                then, now = (followed(f.detect(subset), f.ego.pose) for f in (before, frame))
                which = min(len(subset), CHANGE_SIZES) - 1
                self.changes[kind, which, crowd_bin(crowd(now)), change_bin(changes(then, now))] += 1

    def add(self, frame: DecodedOnce, kind: str | None) -> None:
        """Count what all pairs of a frame show; of an attacked frame, those that an attacker has a part in."""
        self.team = max(self.team, len(frame.team))
        special = complementary(frame) if kind is None else frame.attackers
        for larger in subsets(frame.team)[1:]:
            if kind is not None and larger.isdisjoint(special):
                continue
            for smaller in subsets(sorted(larger))[:-1]:
                pair = measure(_boxes(frame, smaller), frame.detect(larger))
                if pair is not None:
                    joining = larger - smaller
                    row = int(size_row(np.array(len(smaller)), np.array(len(joining))))
                    cell = 2 * (not smaller.isdisjoint(special)) + (not joining.isdisjoint(special))
                    for counted in {0, cell} if kind is None else {cell}:
                        self.pairs[kind, counted, row, pair_bin(pair)] += 1


def complementary(frame: DecodedOnce) -> Subset:
    """Teammates of a frame without attackers that see much of what the others do not: see `ADDED_BOXES`."""
    found = set()
    for name in frame.team:
        others = [other for other in frame.team if other != name]
        parts = [c for size in range(3) for c in combinations(others, size)]
        pairs = [measure(_boxes(frame, frozenset(part)), frame.detect((*part, name))) for part in parts]
        added = [pair.novelty for pair in pairs if pair is not None]
        if added and np.mean(added) >= ADDED_BOXES:
            found.add(name)
    return frozenset(found)


def _boxes(frame: DecodedOnce, subset: Subset) -> FloatArray:
    """What a defence sees of a subset; of the ego alone, the boxes that take part in the comparison."""
    boxes = frame.detect(subset)
    return boxes if subset else at_least(boxes, frame.info.consensus_score)


@dataclass(frozen=True)
class Trial:
    """What verdicts are observed under."""

    attacks: Mapping[str, Attack]
    attackers: Sequence[int]
    """Each attack comes once with each number of attackers, drawn anew."""
    pose_error_m: float = 0.0
    """Standard deviation of the error of each teammate's position along either axis, metres; each frame has its own."""
    stretches_per_scene: int = 1


def validation_stretches(
    detector: Detector,
    scenes: Sequence[Scene],
    trial: Trial,
    rng: np.random.Generator,
    tick: Callable[[], None] = lambda: None,
) -> Iterator[Stretch]:
    """Successive frames without an attack, then the same frames under every attack, the vehicles taking turns as ego.

    ``tick`` is called after each recorded frame.
    """
    some = next(iter(trial.attacks.values()))
    for turn, (scene, number) in enumerate((s, n) for s in scenes for n in range(trial.stretches_per_scene)):
        start = number * STRETCH_STRIDE
        frames = [scene.frame(index) for index in range(start, start + STRETCH)]
        ego_id = whose_turn(scene, turn, *frames)
        met = [Sensed.of(detector, frame, ego_id, trial.pose_error_m, rng) for frame in frames]
        team = sorted({name for sensed in met for name in sensed.messages} - {ego_id})
        other = scenes[(scenes.index(scene) + 1) % len(scenes)]
        foreign = foreign_views(detector, other if other is not scene else None)
        honest: list[DecodedOnce] = []
        attacked = [(kind, attack, count) for kind, attack in trial.attacks.items() for count in trial.attackers]
        for kind, attack, count in [(None, some, 0), *attacked]:
            chosen = [team[i] for i in rng.choice(len(team), count, replace=False)]
            stretch = []
            past = Past(scene.frame_period_s, foreign)
            for index, sensed in enumerate(met):
                frame_met = under_attack(detector, sensed, chosen, attack, rng, past)
                stretch.append(record(frame_met, honest[index] if honest else None))
                tick()
            honest = honest or stretch
            yield kind, stretch


def collect(stretches: Iterable[Stretch]) -> Verdicts:
    """Count the verdicts of stretches."""
    verdicts = Verdicts()
    for kind, stretch in stretches:
        verdicts.add_stretch(stretch, kind)
    return verdicts
