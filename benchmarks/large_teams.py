"""Group testing in large teams: passes until all attackers are named, and the time it takes to decide.

By default no detector runs: a test's outcome is drawn with the calibrated probability of what is true. That flatters
the defence where its likelihoods are wrong, and shows what choosing and learning cost. With ``--sequences N`` the
detector decodes what is asked of it, on test scenes with so many cars, the attackers' messages optimised jointly.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
import typer

from robosac import attacks
from robosac.answers import Verdict
from robosac.calibrated import calibration_of
from robosac.defenses import Outcome
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.defenses.group_testing import model as likelihoods
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.geometry import PairMeasure
from robosac.detectors import Detector, load
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import DecodedOnce, EvaluationFrame, Sensed, under_attack
from robosac.scenes import IntersectionScene
from robosac.scenes.splits import TEST_SEEDS
from robosac.session import Session

LOSSES = np.array([0.0, *likelihoods.LOSS_EDGES])
NOVELTIES = (0, *likelihoods.NOVELTY_EDGES)
CHANGES = (0, *likelihoods.CHANGE_EDGES)
SHOWN = np.tile([0.0, 0.0, 0.0, 0.9], (28, 1))
POSE = np.eye(4)
EGO = "car-1"
DRAWN = ("measure", "followed", "changes")


class _Subset(np.ndarray):  # boxes that only say whose they are
    members: frozenset[str]


REFERENCE = np.zeros((9, 6)).view(_Subset)
REFERENCE.members = frozenset()


@dataclass
class World:
    """Draws outcomes; the bins' lower edges stand for them. PGD, and no other kind, is taken to miss the consensus."""

    model: likelihoods.EvidenceModel
    attackers: frozenset[str]
    kind: int
    rng: np.random.Generator

    def outcome(self, subset: tuple[str, ...], frame: int) -> Outcome:
        boxes = np.zeros((1, 6)).view(_Subset)
        boxes.members = frozenset(subset)
        agrees = self.attackers.isdisjoint(subset) or self.model.kinds[self.kind] != "pgd"
        index, verdict = (0.5, Verdict.CONSENSUS) if agrees else (0.1, Verdict.DISSENSUS)
        return Outcome(subset, index, verdict, boxes, REFERENCE, POSE, frame)

    def evidence(self) -> type[Evidence]:
        """Evidence that is drawn here instead of measured."""
        return type("Drawn", (Evidence,), {name: staticmethod(getattr(self, name)) for name in DRAWN})

    def measure(self, smaller: _Subset, larger: _Subset, *_: object) -> PairMeasure:
        a, d = smaller.members, larger.members - smaller.members
        cell = 2 * (not self.attackers.isdisjoint(a)) + (not self.attackers.isdisjoint(d))
        row = likelihoods.CLEAN + likelihoods.CELLS * self.kind + cell - 1 if cell else 0
        table = self.model.tables(np.array([len(a)]), np.array([len(d)]))[0, row]
        loss, novelty = divmod(int(self.rng.choice(len(table), p=table)), likelihoods.NOVELTY_BINS)
        return PairMeasure(float(LOSSES[loss]), NOVELTIES[novelty])

    def followed(self, boxes: _Subset, pose: np.ndarray) -> _Subset:  # noqa: ARG002
        shown = SHOWN.view(_Subset)
        shown.members = boxes.members
        return shown

    def changes(self, before: np.ndarray, now: _Subset, *_: object) -> int:  # noqa: ARG002
        row = 0 if self.attackers.isdisjoint(now.members) else 1 + self.kind
        size = min(len(now.members), likelihoods.CHANGE_SIZES)
        table = self.model.changes[row, size - 1, likelihoods.crowd_bin(len(SHOWN))]
        return CHANGES[int(self.rng.choice(len(table), p=table))]


def main(
    teammates: int = 20,
    attackers: int = 4,
    kind: str = "pgd",
    runs: int = 20,
    frames: int = 30,
    sequences: Annotated[int, typer.Option(help="Test scenes to play with the detector; 0: draw outcomes.")] = 0,
) -> None:
    """Print passes until all are suspected as much as naming takes, honest teammates of whom that is ever true, time to
    decide a frame, and size of the state; with the detector, passes until all are named, and precision instead of the
    last two.

    Nobody is named by drawn outcomes: naming takes objects or steadiness besides, and those cannot be drawn.
    """
    if sequences:
        play_scenes(teammates, attackers, kind, frames, sequences)
    else:
        draw(teammates, attackers, kind, runs, frames)


def draw(teammates: int, attackers: int, kind: str, runs: int, frames: int) -> None:
    """Outcomes drawn from the likelihoods."""
    calibrated = GroupTestingSettings().build(calibration_of(load().info))
    team = [f"v{i:03d}" for i in range(teammates)]
    rng = np.random.default_rng(0)
    until_named, seconds, passes, honest, sizes = [], [], [], set(), []
    for run in range(runs):
        bad = frozenset(str(name) for name in rng.choice(team, attackers, replace=False))
        world = World(calibrated.model, bad, calibrated.model.kinds.index(kind), rng)
        defense = replace(calibrated, evidence=world.evidence())
        state, spent, done = defense.initial_state(team), 0, None
        for frame in range(frames):
            before, deciding, tested = spent, 0.0, None
            conversation = defense.converse(team, state, rng)
            try:
                while True:
                    started = time.perf_counter()
                    batch = conversation.send(tested)
                    deciding += time.perf_counter() - started
                    spent += 1
                    tested = [world.outcome(batch[0], frame)]
            except StopIteration as stop:
                decision = stop.value
            seconds.append(deciding + time.perf_counter() - started)
            state = decision.state
            passes.append(spent - before)
            found = {name for name, p in decision.suspicion.items() if p > calibrated.settings.naming_bound}
            honest |= {(run, name) for name in found - bad}
            if done is None and bad <= found:
                done = spent
        until_named.append(done)
        sizes.append(len(json.dumps(state)))
    print(f"{runs} runs, {teammates} teammates, {attackers} x {kind}, {frames} frames")
    _print_named(until_named, "suspected")
    print(f"honest suspected: {len(honest)} of {runs * (teammates - attackers)}")
    print(f"{np.mean(passes):.2f} passes and {1e3 * np.mean(seconds):.1f} ms of deciding a frame")
    print(f"state: {np.mean(sizes) / 1e3:.1f} kB of JSON")


def play_scenes(teammates: int, attackers: int, kind: str, frames: int, sequences: int) -> None:
    """What the detector decodes, on scenes with as many cars as teammates: car-1 is the ego, the roadside unit one of
    them.
    """
    torch.set_num_threads(1)
    detector = load()
    defense = GroupTestingSettings().build(calibration_of(detector.info))
    ours, oracle, undefended = AveragePrecision(), AveragePrecision(), AveragePrecision()
    until_named, passes, infiltrated, honest = [], [], [], 0
    for seed in TEST_SEEDS[:sequences]:
        rng = np.random.default_rng(seed)
        scene = IntersectionScene(seed, car_agents=teammates)
        team = sorted(set(scene.agents) - {EGO})
        bad = frozenset(str(name) for name in rng.choice(team, attackers, replace=False))
        session, spent, done, accused = Session(detector, team, defense, rng=rng), 0, None, set()
        for index, met in enumerate(_attacked(detector, scene, kind, bad, frames, rng)):
            decoded = DecodedOnce.of(met)
            result = session.answer(index, met.ego, met.teammates, detector=decoded)
            if result.fault is not None:
                raise RuntimeError(f"scene {seed}, frame {index}: {result.fault}")
            spent += result.sampling_steps
            passes.append(result.sampling_steps)
            infiltrated.append(not bad.isdisjoint(result.accepted))
            accused |= set(result.named or ())
            if done is None and bad <= set(result.named or ()):
                done = spent
            ours.add(result.boxes, met.truth)
            oracle.add(decoded.detect(set(team) - bad), met.truth)
            undefended.add(decoded.detect(team), met.truth)
        until_named.append(done)
        honest += len(accused - bad)
    print(f"{sequences} scenes, {teammates} teammates, {attackers} x {kind}, {frames} frames")
    _print_named(until_named, "named")
    print(f"honest named: {honest} of {sequences * (teammates - attackers)}")
    print(f"{np.mean(passes):.2f} passes a frame; an attacker in {sum(infiltrated)} of {len(infiltrated)} answers")
    for name, precision in (("group testing", ours), ("oracle", oracle), ("no defence", undefended)):
        print(f"{name}: AP50/AP70 {precision.at(0.5):.3f}/{precision.at(0.7):.3f}")


def _attacked(
    detector: Detector, scene: IntersectionScene, kind: str, bad: frozenset[str], frames: int, rng: np.random.Generator
) -> Iterator[EvaluationFrame]:
    attack = attacks.load(kind)
    for index in range(frames):
        yield under_attack(detector, Sensed.of(detector, scene.frame(index), EGO, 0.0, rng), bad, attack, rng)


def _print_named(until_named: Sequence[int | None], what: str) -> None:
    named = [n for n in until_named if n is not None]
    print(f"all {what} in {len(named)} of {len(until_named)}", end="")
    if named:
        print(
            f", after {np.mean(named):.1f} passes on average, median {np.median(named):.0f}, most {max(named)}", end=""
        )
    print()


if __name__ == "__main__":
    typer.run(main)
