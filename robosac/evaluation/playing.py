"""Defences on sequences of frames, recorded or live: what they answer, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robosac.defenses import Defense
from robosac.evaluation.frames import EvaluationFrame
from robosac.fusion import FusionResult
from robosac.session import Session


class FaultyDefense(RuntimeError):
    """A defence failed on a frame; an evaluation must not answer over that."""


@dataclass(frozen=True)
class Answer:
    """What a defence made of one frame."""

    result: FusionResult
    milliseconds: float
    """For all of it."""

    @property
    def passes(self) -> int:
        """Fused subsets that were decoded, those of the answer among them; a subset is decoded once a frame."""
        decoded = {outcome.teammates for outcome in self.result.hypotheses} | {self.result.accepted}
        return len(decoded - {()})


def play(defense: Defense, sequence: Sequence[EvaluationFrame], rng: np.random.Generator) -> list[Answer]:
    """Answer a sequence frame by frame, the defence remembering what it remembers.

    Raises
    ------
    FaultyDefense
        If a fusion failed.
    """
    team = sorted({name for frame in sequence for name in frame.team})
    session = Session(sequence[0], team, defense, rng=rng)
    answers = []
    for index, frame in enumerate(sequence):
        started = time.perf_counter()
        result = session.answer(index, frame.ego, frame.teammates, detector=frame)
        answers.append(Answer(result, (time.perf_counter() - started) * 1e3))
        if result.fault is not None:
            raise FaultyDefense(f"frame {index}: {result.fault}")
    return answers
