"""Defences on recorded sequences: what they answer, what it costs, whom they name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses import Defense, Reason, State
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.recordings import RecordedFrame
from robosac.fusion import FusionResult, fuse
from robosac.previous import PreviousAnswer


def play(defense: Defense, sequence: Sequence[RecordedFrame], rng: np.random.Generator) -> list[FusionResult]:
    """Answer a sequence frame by frame, the defence remembering what it remembers.

    Raises
    ------
    RuntimeError
        If a fusion failed: in an evaluation a fault is not answered over.
    """
    state: State = defense.initial_state(list(sequence[0].team))
    previous: PreviousAnswer | None = None
    results = []
    for index, frame in enumerate(sequence):
        result = fuse(frame, defense, frame.ego, frame.teammates, rng=rng, state=state, frame=index, previous=previous)
        if result.fault is not None:
            raise RuntimeError(f"frame {index}: {result.fault}")
        state, previous = result.state, result.previous
        results.append(result)
    return results


@dataclass
class Tally:
    """Collects played sequences.

    Attributes
    ----------
    steady_from : int
        Frames before are counted apart, and not by the average precision.
    ap, oracle, undefended : AveragePrecision
        Of the answers; of the fusion of all that do not attack; of the fusion of everybody.
    first, early, steady : list of int
        Passes of first frames, of the others before ``steady_from``, and of those from there on.
    infiltrated : list of bool
        Whether an attacker is in the answer, from ``steady_from`` on.
    honest_named, honest : int
        Honest teammates of a sequence that were named at any time, and all of them.
    unnamed, attackers : int
        Attackers of a sequence that were never named, and all of them.
    frames_to_name : list of int
        Of each named attacker, frames since the sequence began, at least 1.
    """

    steady_from: int = 5
    ap: AveragePrecision = field(default_factory=AveragePrecision)
    oracle: AveragePrecision = field(default_factory=AveragePrecision)
    undefended: AveragePrecision = field(default_factory=AveragePrecision)
    first: list[int] = field(default_factory=list)
    early: list[int] = field(default_factory=list)
    steady: list[int] = field(default_factory=list)
    infiltrated: list[bool] = field(default_factory=list)
    honest_named: int = 0
    honest: int = 0
    unnamed: int = 0
    attackers: int = 0
    frames_to_name: list[int] = field(default_factory=list)

    def add(self, sequence: Sequence[RecordedFrame], results: Sequence[FusionResult]) -> None:
        """Add a sequence and what was answered to it."""
        named: dict[str, int] = {}
        for index, (frame, result) in enumerate(zip(sequence, results, strict=True)):
            for name, rejection in result.rejected.items():
                if rejection.reason is Reason.DISTRUSTED:
                    named.setdefault(name, index + 1)
            passes = self.first if index == 0 else self.early if index < self.steady_from else self.steady
            passes.append(result.sampling_steps)
            if index >= self.steady_from:
                self._precision(frame, result.boxes)
                self.infiltrated.append(not frame.attackers.isdisjoint(result.accepted))
        bad = frozenset().union(*(frame.attackers for frame in sequence))
        self.honest += len(set(sequence[0].team) - bad)
        self.honest_named += len(set(named) - bad)
        self.attackers += len(bad)
        self.unnamed += len(bad - set(named))
        self.frames_to_name += [named[name] for name in sorted(bad & set(named))]

    def _precision(self, frame: RecordedFrame, boxes: FloatArray) -> None:
        self.ap.add(boxes, frame.truth)
        self.oracle.add(frame.detect(frame.benign), frame.truth)
        self.undefended.add(frame.detect(frame.team), frame.truth)
