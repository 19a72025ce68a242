"""The table of bounds: Algorithm 1 between what collaboration can give and what an attacker can take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from robosac.attacks import Attack, Campaign
from robosac.defenses import SampleConsensus
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import DecodedOnce, EvaluationFrame

ASSUMED_RATIO = 0.2


class NoFrames(ValueError):
    """There is nothing to evaluate."""


@dataclass(frozen=True)
class BoundsRow:
    """One line of the table."""

    name: str
    ap50: float
    ap70: float
    """Average precision at IoU 0.5 and 0.7."""
    mean_steps: float | None = None
    success_rate: float | None = None
    infiltrated: float | None = None
    """For sampling rows: hypotheses tested a frame, share of frames with a consensus, and share of frames whose answer
    holds an attacker's message.
    """


@dataclass(frozen=True)
class BoundsReport:
    """The table and the error rates of the consensus test."""

    rows: list[BoundsRow]
    frames: int
    skipped: int
    false_alarm_rate: float | None
    miss_rate: float | None
    """Share of attacker-free hypotheses refused, and of attacked ones let through, over all hypotheses of the size
    used; None where there is no such hypothesis.
    """
    benign_hypotheses: int
    attacked_hypotheses: int
    """How many those are."""
    perturbation_to_feature_ratio: float | None
    """The attack's bound over the 95th percentile of the magnitude of benign messages; None where that is 0."""


@dataclass(frozen=True)
class Sampling:
    """How Algorithm 1 is run."""

    attackers: int = 1
    team_size: int = 5
    """Their ratio is what the defence assumes; that is `ASSUMED_RATIO` if nobody attacks."""
    collaborators: int = 3
    """s, the size of a hypothesis."""
    budgets: tuple[int, ...] = (7, 5, 3, 1)
    """One row of Algorithm 1 for each, with independent draws as in the paper; one for the first of them where no
    subset is drawn twice in a frame; and one of `SampleConsensus` with its other settings by default, which choose the
    hypotheses' size too.
    """
    repeats: int = 10
    """Runs of Algorithm 1 on each frame, so that the luck of its draws averages out; the fused passes are shared."""
    seed: int = 0
    stream: int = 1
    """Of the draws."""

    def defenses(self) -> dict[str, SampleConsensus]:
        """The defences, by the names of their rows."""
        ratio, s = self.attackers / self.team_size if self.attackers else ASSUMED_RATIO, self.collaborators
        given = {"attacker_ratio": ratio, "collaborators": s}
        rows = {f"Algorithm 1, N = {n}": SampleConsensus.independent(**given, sampling_budget=n) for n in self.budgets}
        rows[f"no subset twice, N = {self.budgets[0]}"] = SampleConsensus(**given, sampling_budget=self.budgets[0])
        return rows | {"sample_consensus": SampleConsensus(attacker_ratio=ratio)}


def evaluate_bounds(
    frames: Iterable[EvaluationFrame | None],
    attack: Attack | Campaign,
    sampling: Sampling = Sampling(),
    tick: Callable[[], None] = lambda: None,
) -> BoundsReport:
    """Compute the table of bounds. ``tick`` is called after each frame.

    Parameters
    ----------
    frames : iterable of EvaluationFrame or None
        From `robosac.evaluation.frames`, made with this attack and number of attackers; None is skipped.

    Raises
    ------
    NoFrames
        If there is no frame with enough teammates.
    """
    table = _Table(sampling)
    for index, frame in enumerate(frames):
        table.add(
            frame, [sampling.seed, sampling.stream, index]
        )  # each row has the same luck, whatever else is evaluated
        tick()
    return table.report(attack.epsilon)


class _Table:
    def __init__(self, sampling: Sampling) -> None:
        self._s = sampling.collaborators
        self._samplers = sampling.defenses()
        self._repeats = sampling.repeats
        self._frames = self._skipped = 0
        names = ["all benign", f"{self._s} benign", *self._samplers, "ego only", "no defence"]
        self._ap = {name: AveragePrecision() for name in names}
        self._runs: dict[str, list[tuple[int, bool, bool]]] = {name: [] for name in self._samplers}
        self._refused: list[bool] = []
        self._missed: list[bool] = []
        self._magnitudes: list[float] = []

    def add(self, frame: EvaluationFrame | None, seed: Sequence[int]) -> None:
        if frame is None:
            self._skipped += 1
            return
        benign, received = DecodedOnce.of(replace(frame, teammates=frame.benign)), DecodedOnce.of(frame)
        team = list(frame.benign)
        for subset in combinations(team, self._s):
            self._ap[f"{self._s} benign"].add(benign.detect(subset), frame.truth)
        self._ap["all benign"].add(benign.detect(team), frame.truth)
        self._ap["ego only"].add(benign.detect(), frame.truth)
        self._ap["no defence"].add(received.detect(frame.team), frame.truth)
        refused, missed = received.judged(self._s)
        self._refused += refused
        self._missed += missed
        for name, sampler in self._samplers.items():
            for result in received.answers(sampler, seed, self._repeats):
                self._ap[name].add(result.boxes, frame.truth)
                infiltrated = not frame.attackers.isdisjoint(result.accepted)
                self._runs[name].append((result.sampling_steps, bool(result.accepted), infiltrated))
        magnitudes = np.abs(np.concatenate([t.ravel() for m in frame.benign.values() for t in m.tensors.values()]))
        self._magnitudes.append(float(np.percentile(magnitudes, 95)))
        self._frames += 1

    def report(self, epsilon: float) -> BoundsReport:
        if not self._frames:
            raise NoFrames("there is no frame to evaluate, or none with enough teammates")
        rows = []
        for name, ap in self._ap.items():
            runs = np.mean(self._runs[name], axis=0) if name in self._runs else (None, None, None)
            rows.append(BoundsRow(name, ap.at(0.5), ap.at(0.7), *(None if v is None else float(v) for v in runs)))
        magnitude = float(np.mean(self._magnitudes))
        return BoundsReport(
            rows=rows,
            frames=self._frames,
            skipped=self._skipped,
            false_alarm_rate=float(np.mean(self._refused)) if self._refused else None,
            miss_rate=float(np.mean(self._missed)) if self._missed else None,
            benign_hypotheses=len(self._refused),
            attacked_hypotheses=len(self._missed),
            perturbation_to_feature_ratio=epsilon / magnitude if magnitude else None,
        )
