"""Verdicts on validation frames: what tests say when it is known who attacks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from robosac.attacks import Attack
from robosac.boxes import FloatArray
from robosac.consensus import at_least
from robosac.defenses.group_testing.geometry import measure
from robosac.defenses.group_testing.model import pair_bin, size_row
from robosac.detectors import Detector
from robosac.evaluation.frames import encode_all, misplaced, under_attack
from robosac.evaluation.recordings import RecordedFrame, Subset, record
from robosac.scenes import IntersectionScene

FRAME_STRIDE = 10
"""Frames of a scene are this many periods of 0.2 s apart, so that they differ."""
ADDED_BOXES = 1.0
"""A benign teammate is complementary if it adds so many boxes, on average, to fusions of up to two others."""
PairKey = tuple[str | None, int, int, int]
"""Kind of attack (None: nobody attacks in the pair), cell, row of `SIZES`, bin.

Cells of a kind: 1 if only in d somebody attacks, 2 if only in a, 3 if in both. Without an attack the cells say so of
those that are complementary, and 0 is for all pairs, whoever is.
"""


@dataclass
class Verdicts:
    """Counts of what was observed, by what was true.

    Attributes
    ----------
    pairs : Counter of PairKey
    """

    pairs: Counter[PairKey] = field(default_factory=Counter)

    def add(self, frame: RecordedFrame, kind: str | None) -> None:
        """Count what all pairs of a frame show; of an attacked frame, those that an attacker has a part in."""
        special = complementary(frame) if kind is None else frame.attackers
        subsets = [s for size in range(1, len(frame.team) + 1) for s in combinations(frame.team, size)]
        for larger in map(frozenset, subsets):
            if kind is not None and larger.isdisjoint(special):
                continue
            for smaller in _proper_parts(larger):
                pair = measure(_boxes(frame, smaller), frame.detect(larger))
                if pair is not None:
                    joining = larger - smaller
                    row = int(size_row(np.array(len(smaller)), np.array(len(joining))))
                    cell = 2 * (not smaller.isdisjoint(special)) + (not joining.isdisjoint(special))
                    for counted in {0, cell} if kind is None else {cell}:
                        self.pairs[kind, counted, row, pair_bin(pair)] += 1


def complementary(frame: RecordedFrame) -> Subset:
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


def _boxes(frame: RecordedFrame, subset: Subset) -> FloatArray:
    """What a defence sees of a subset; of the ego alone, the boxes that take part in the comparison."""
    boxes = frame.detect(subset)
    return boxes if subset else at_least(boxes, frame.info.consensus_score)


def validation_frames(
    detector: Detector,
    seeds: Sequence[int],
    frames_per_scene: int,
    attacks: Mapping[str, Attack],
    attackers: Sequence[int],
    pose_error_m: float,
    rng: np.random.Generator,
) -> Iterator[tuple[str | None, RecordedFrame]]:
    """Frames without an attack, each followed by the same frame under every attack, the cars taking turns as ego.

    Parameters
    ----------
    detector : Detector
    seeds : sequence of int
        Scenes.
    frames_per_scene : int
    attacks : mapping of kind to Attack
    attackers : sequence of int
        Each attack comes once with each number of attackers, drawn anew.
    pose_error_m : float
        Standard deviation of the error of each teammate's position along either axis, metres.
    rng : numpy.random.Generator

    Yields
    ------
    kind, frame : str or None, RecordedFrame
    """
    turn = 0
    for seed in seeds:
        scene = IntersectionScene(seed)
        for frame in scene.frames(frames_per_scene, stride=FRAME_STRIDE):
            ego_id = f"car-{turn % scene.car_agents + 1}"
            turn += 1
            messages = encode_all(detector, frame)
            met = {n: m if n == ego_id else misplaced(m, pose_error_m, rng) for n, m in messages.items()}
            truth = frame.truth(ego_id)
            team = sorted(set(met) - {ego_id})
            honest = None
            for kind, attack, count in [(None, None, 0), *((k, a, n) for k, a in attacks.items() for n in attackers)]:
                chosen = [team[i] for i in rng.choice(len(team), count, replace=False)]
                some = attack or next(iter(attacks.values()))
                recorded = record(detector, under_attack(detector, met, truth, ego_id, chosen, some, rng), honest)
                honest = honest or recorded
                yield kind, recorded


def collect(frames: Iterator[tuple[str | None, RecordedFrame]], tick: Callable[[], None] = lambda: None) -> Verdicts:
    """Count the verdicts of frames; ``tick`` is called after each."""
    verdicts = Verdicts()
    for kind, frame in frames:
        verdicts.add(frame, kind)
        tick()
    return verdicts


def _proper_parts(larger: Subset) -> Iterator[Subset]:
    members = sorted(larger)
    for size in range(len(members)):
        yield from map(frozenset, combinations(members, size))
