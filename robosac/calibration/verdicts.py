"""Verdicts on validation frames: what tests say when it is known who attacks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from robosac.attacks import Attack
from robosac.consensus import at_least, compare
from robosac.defenses.group_testing.geometry import MIN_WITNESSES, measure
from robosac.defenses.group_testing.model import JOINING_SIZES, SIZES, WITNESS_SIZES, jaccard_bin, pair_bin
from robosac.detectors import Detector
from robosac.evaluation.frames import encode_all, misplaced, under_attack
from robosac.evaluation.recordings import RecordedFrame, Subset, record
from robosac.scenes import IntersectionScene

FRAME_STRIDE = 10
"""Frames of a scene are this many periods of 0.2 s apart, so that they differ."""
JaccardKey = tuple[str | None, int, int]
"""Kind of attack (None: no attacker in the subset), size of the subset, bin."""
PairKey = tuple[str | None, int, int, int, int]
"""Kind, cell (0: both clean; then d dirty, a dirty, both), sizes of a and d, bin."""


@dataclass
class Verdicts:
    """Counts of what was observed, by what was true.

    Attributes
    ----------
    jaccard : Counter of JaccardKey
    pairs : Counter of PairKey
    """

    jaccard: Counter[JaccardKey] = field(default_factory=Counter)
    pairs: Counter[PairKey] = field(default_factory=Counter)

    def add(self, frame: RecordedFrame, kind: str | None) -> None:
        """Count what all subsets of a frame show; of an attacked frame, those that an attacker has a part in."""
        score = frame.info.consensus_score
        reference = at_least(frame.detect(), score)
        subsets = [s for size in range(1, len(frame.team) + 1) for s in combinations(frame.team, size)]
        for larger in map(frozenset, subsets):
            if (kind is None) != larger.isdisjoint(frame.attackers):
                continue
            boxes = frame.detect(larger)
            if len(reference) >= MIN_WITNESSES:
                index = compare(reference, at_least(boxes, score)).jaccard_index
                self.jaccard[kind, min(len(larger), SIZES), jaccard_bin(index)] += 1
            for smaller in _proper_parts(larger):
                pair = measure(frame.detect(smaller), boxes)
                if pair is not None:
                    joining = larger - smaller
                    sizes = min(len(smaller), WITNESS_SIZES), min(len(joining), JOINING_SIZES)
                    self.pairs[kind, _cell(frame, smaller, joining), *sizes, pair_bin(pair)] += 1


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
    for size in range(1, len(members)):
        yield from map(frozenset, combinations(members, size))


def _cell(frame: RecordedFrame, a: Subset, d: Subset) -> int:
    """0 if nobody attacks; 1 if only in d, 2 if only in a, 3 if in both."""
    return 2 * (not a.isdisjoint(frame.attackers)) + (not d.isdisjoint(frame.attackers))
