"""Experiments on sequences at 5 Hz: static against dynamic teams, temporal consistency."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from robosac.answers import Verdict
from robosac.boxes import FloatArray
from robosac.consensus import at_least, compare
from robosac.defenses import Defense, Reference, SampleConsensus, StaticTeam, Undefended
from robosac.evaluation.experiments import paper
from robosac.evaluation.experiments.common import Context, precision
from robosac.evaluation.frames import DecodedOnce
from robosac.evaluation.report import Section, Table
from robosac.fusion import FusionResult
from robosac.previous import PreviousAnswer
from robosac.session import Session

STEADY_FROM = 5
BUDGET = 7
COLLABORATORS = 3
PAPER = {
    "dynamic team": paper.DYNAMIC,
    "static team, no re-check": paper.STATIC,
    "temporal consistency": paper.TEMPORAL,
}


@dataclass
class _Run:
    """What a defence did on all sequences."""

    answers: list[tuple[DecodedOnce, FusionResult]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    steady_seconds: list[float] = field(default_factory=list)


def _play(context: Context, defenses: dict[str, Defense]) -> dict[str, _Run]:
    """Every defence on the same sequences; each frame is timed with the defences in turn, so that they share its
    noise.
    """
    runs = {name: _Run() for name in defenses}
    for number in range(context.scale.sequences):
        sequence = context.sequence(number)
        for repeat in range(context.scale.repeats):
            team = sequence[0].team
            sessions = {name: Session(context.detector, team, defense) for name, defense in defenses.items()}
            for index, recorded in enumerate(sequence):
                for stream, (name, session) in enumerate(sessions.items()):
                    rng = context.rng(10, number, repeat, index, stream)
                    started = time.perf_counter()
                    result = session.decide(index, recorded.ego, recorded.teammates, rng)
                    seconds = time.perf_counter() - started
                    session.remember(result)
                    run = runs[name]
                    run.answers.append((recorded, result))
                    run.seconds.append(seconds)
                    if index >= STEADY_FROM:
                        run.steady_seconds.append(seconds)
    return runs


def teams(context: Context) -> Section:
    """Static against dynamic team, and temporal consistency."""
    tested = {"sampling_budget": BUDGET, "collaborators": COLLABORATORS}
    defenses: dict[str, Defense] = {
        "undefended": Undefended(),
        "dynamic team": SampleConsensus(**tested),
        "static team, re-check every 10": StaticTeam(**tested),
        "static team, no re-check": StaticTeam(**tested, recheck_every=None),
        "temporal consistency": SampleConsensus(**tested, reference=Reference.PREVIOUS),
    }
    runs = _play(context, defenses)
    baseline = runs["undefended"].steady_seconds
    rows = [_line(name, run, baseline) for name, run in runs.items()]
    ego, previous = _false_alarms(context)
    alarms = [("ego", round(ego, 4)), ("previous answer", round(previous, 4))]
    return Section(
        "Static team, dynamic team, temporal consistency",
        f"{context.scale.sequences} sequences of {context.scale.sequence_frames} frames at 5 Hz, one PGD attacker of "
        f"five, gone through {context.scale.repeats} times. FPS are measured (one CPU thread, fusion alone); those of "
        f"the paper are computed from constants. Costs are of frames from the {STEADY_FROM + 1}th on, over those of an "
        "undefended fused frame timed in the same run. The previous answer is compared with after its boxes were moved "
        f"on by a frame; it refuses {previous:.1%} of the attacker-free hypotheses, the ego's own perception "
        f"{ego:.1%}.",
        [
            Table.of(rows, "teams", "Sessions with and without memory"),
            Table(
                "references", "False alarms over all attacker-free hypotheses of three", ("reference", "rate"), alarms
            ),
        ],
    )


def _line(name: str, run: _Run, baseline: list[float]) -> dict[str, object]:
    paper_ap50, paper_ap70, _, paper_fps = PAPER.get(name, (None, None, None, None))
    ap50, ap70 = precision((result.boxes, frame.truth) for frame, result in run.answers)
    infiltrated = [not frame.attackers.isdisjoint(result.accepted) for frame, result in run.answers]
    return {
        "session": name,
        "AP50 %, paper": paper_ap50,
        "AP70 %, paper": paper_ap70,
        "AP50": round(ap50, 3),
        "AP70": round(ap70, 3),
        "steps": round(float(np.mean([result.sampling_steps for _, result in run.answers])), 2),
        "answered together": round(float(np.mean([bool(result.accepted) for _, result in run.answers])), 3),
        "attacker in answer": round(float(np.mean(infiltrated)), 3),
        "FPS, paper": paper_fps,
        "FPS, measured": round(len(run.seconds) / sum(run.seconds), 1),
        "median cost": round(float(np.median(run.steady_seconds) / np.median(baseline)), 3),
        "mean cost": round(float(np.mean(run.steady_seconds) / np.mean(baseline)), 3),
    }


def _false_alarms(context: Context) -> tuple[float, float]:
    """Rates against the ego and against the previous answer (of three random honest teammates in each frame)."""
    by_ego, by_previous = [], []
    for number in range(context.scale.sequences):
        before: PreviousAnswer | None = None
        for index, recorded in enumerate(context.sequence(number)):
            honest = sorted(set(recorded.teammates) - recorded.attackers)
            subsets = list(combinations(honest, COLLABORATORS))
            if before is not None:
                moved = at_least(before.expected_at(recorded.ego.pose), recorded.info.consensus_score)
                by_ego += [_refused(recorded, recorded.confident(), subset) for subset in subsets]
                by_previous += [_refused(recorded, moved, subset) for subset in subsets]
            chosen = subsets[int(context.rng(11, number, index).integers(len(subsets)))]
            before = PreviousAnswer.of(index, recorded.ego.pose, recorded.detect(chosen), before)
    return float(np.mean(by_ego)), float(np.mean(by_previous))


def _refused(recorded: DecodedOnce, reference: FloatArray, subset: tuple[str, ...]) -> bool:
    return compare(reference, recorded.confident(subset)).verdict is Verdict.DISSENSUS
