"""Group testing in large teams, on verdicts drawn from its own likelihoods: passes until all attackers are named, and
the time it takes to decide.

No detector runs: a test's outcome is drawn with the calibrated probability of what is true. That flatters the defence
where its likelihoods are wrong, and shows what choosing and learning cost.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

import numpy as np
import typer

from robosac.calibration import calibration_of
from robosac.consensus import Verdict
from robosac.defenses import GroupTesting, Outcome
from robosac.defenses.group_testing import frame as judging
from robosac.defenses.group_testing import model as likelihoods
from robosac.defenses.group_testing.geometry import PairMeasure
from robosac.detectors import load

LOSSES = np.array([0.0, *likelihoods.LOSS_EDGES])
NOVELTIES = (0, *likelihoods.NOVELTY_EDGES)
INDICES = np.array([0.0, *likelihoods.JACCARD_EDGES])
REFERENCE = np.zeros((9, 6))


class _Subset(np.ndarray):  # boxes that only say whose they are
    members: frozenset[str]


@dataclass
class World:
    """Draws outcomes; the bins' lower edges stand for them."""

    model: likelihoods.EvidenceModel
    attackers: frozenset[str]
    kind: int
    rng: np.random.Generator

    def outcome(self, subset: tuple[str, ...]) -> Outcome:
        row = 0 if self.attackers.isdisjoint(subset) else 2 + likelihoods.CELLS * self.kind
        table = self.model.jaccard_tables(np.array([len(subset)]))[0, row]
        index = float(INDICES[self.rng.choice(len(table), p=table)])
        boxes = np.zeros((1, 6)).view(_Subset)
        boxes.members = frozenset(subset)
        verdict = Verdict.CONSENSUS if index >= 0.3 else Verdict.DISSENSUS
        return Outcome(subset, index, verdict, boxes, REFERENCE)

    def measure(self, smaller: _Subset, larger: _Subset) -> PairMeasure:
        a, d = smaller.members, larger.members - smaller.members
        cell = 2 * (not self.attackers.isdisjoint(a)) + (not self.attackers.isdisjoint(d))
        row = likelihoods.CELLS * self.kind + cell if cell else 0
        table = self.model.pair_tables(np.array([len(a)]), np.array([len(d)]))[0, row]
        loss, novelty = divmod(int(self.rng.choice(len(table), p=table)), likelihoods.NOVELTY_BINS)
        return PairMeasure(float(LOSSES[loss]), NOVELTIES[novelty])


def main(teammates: int = 20, attackers: int = 4, kind: str = "pgd", runs: int = 20, frames: int = 30) -> None:
    """Print passes until all are named, honest teammates named, time to decide a frame, and size of the state."""
    defense = GroupTesting.calibrated(calibration_of(load().info))
    team = [f"v{i:03d}" for i in range(teammates)]
    rng = np.random.default_rng(0)
    until_named, seconds, passes, honest, sizes = [], [], [], set(), []
    for run in range(runs):
        bad = frozenset(str(name) for name in rng.choice(team, attackers, replace=False))
        world = World(defense.model, bad, defense.model.kinds.index(kind), rng)
        judging.measure = world.measure  # type: ignore[assignment]
        state, spent, done = defense.initial_state(team), 0, None
        for _ in range(frames):
            before, deciding, tested = spent, 0.0, None
            conversation = defense.converse(team, state, rng)
            try:
                while True:
                    started = time.perf_counter()
                    batch = conversation.send(tested)
                    deciding += time.perf_counter() - started
                    spent += 1
                    tested = [world.outcome(batch[0])]
            except StopIteration as stop:
                state = stop.value.state
            seconds.append(deciding + time.perf_counter() - started)
            passes.append(spent - before)
            honest |= {(run, name) for name in state["named"] if name not in bad}
            if done is None and bad <= set(state["named"]):
                done = spent
        until_named.append(done)
        sizes.append(len(json.dumps(state)))
    named = [n for n in until_named if n is not None]
    print(f"{runs} runs, {teammates} teammates, {attackers} x {kind}, {frames} frames")
    print(
        f"all named in {len(named)} runs, after {np.mean(named):.1f} passes on average, median {np.median(named):.0f}"
    )
    print(f"honest named: {len(honest)} of {runs * (teammates - attackers)}")
    print(f"{np.mean(passes):.2f} passes and {1e3 * np.mean(seconds):.1f} ms of deciding a frame")
    print(f"state: {np.mean(sizes) / 1e3:.1f} kB of JSON")


if __name__ == "__main__":
    typer.run(main)
