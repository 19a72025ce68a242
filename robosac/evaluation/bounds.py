"""The table of bounds: Algorithm 1 between what collaboration can give and what an attacker can take."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from robosac.attacks import Attack
from robosac.boxes import FloatArray
from robosac.consensus import Verdict, at_least, compare
from robosac.defenses import SampleConsensus
from robosac.detectors import Detector, Message, PreparedFrame
from robosac.evaluation.average_precision import AveragePrecision
from robosac.fusion import fuse
from robosac.scenes import FRAMES_PER_SECOND, IntersectionScene, SceneFrame

TEAM_SIZE = 5
ASSUMED_RATIO = 0.2


@dataclass(frozen=True)
class EvaluationFrame:
    """One test frame as its ego meets it.

    Attributes
    ----------
    ego : Message
    benign : dict of teammate to Message
    received : dict of teammate to Message
        With the attackers' messages in place of their benign ones.
    attackers : frozenset of str
    truth : (G, 5) ndarray
        Ego frame.
    """

    ego: Message
    benign: dict[str, Message]
    received: dict[str, Message]
    attackers: frozenset[str]
    truth: FloatArray


@dataclass(frozen=True)
class BoundsRow:
    """One line of the table.

    Attributes
    ----------
    name : str
    ap50, ap70 : float
        Average precision at IoU 0.5 and 0.7.
    mean_steps, success_rate, infiltrated : float or None
        For sampling rows: hypotheses tested a frame, share of frames with a consensus, and share of frames whose answer
        holds an attacker's message.
    """

    name: str
    ap50: float
    ap70: float
    mean_steps: float | None = None
    success_rate: float | None = None
    infiltrated: float | None = None


@dataclass(frozen=True)
class BoundsReport:
    """The table and the error rates of the consensus test.

    Attributes
    ----------
    rows : list of BoundsRow
    frames : int
    false_alarm_rate, miss_rate : float or None
        Share of attacker-free hypotheses refused, and of attacked ones let through, over all hypotheses of the size
        used; None where there is no such hypothesis.
    benign_hypotheses, attacked_hypotheses : int
        How many those are.
    perturbation_to_feature_ratio : float
        The attack's bound over the 95th percentile of the magnitude of benign messages.
    """

    rows: list[BoundsRow]
    frames: int
    false_alarm_rate: float | None
    miss_rate: float | None
    benign_hypotheses: int
    attacked_hypotheses: int
    perturbation_to_feature_ratio: float


def under_attack(
    detector: Detector,
    frame: SceneFrame,
    ego_id: str,
    attackers: Sequence[str],
    attack: Attack,
    rng: np.random.Generator,
) -> EvaluationFrame:
    """A frame of a scene as one ego meets it, with some teammates under the adversary's control."""
    messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
    ego = messages.pop(ego_id)
    adversarial = attack.run(detector.attack_surface(ego, messages), attackers, rng) if attackers else {}
    received = {
        name: detector.perturbed(message, adversarial[name]) if name in adversarial else message
        for name, message in messages.items()
    }
    return EvaluationFrame(ego, messages, received, frozenset(adversarial), frame.truth(ego_id))


def evaluation_frames(
    detector: Detector,
    seeds: Sequence[int],
    frames_per_scene: int,
    attack: Attack,
    attackers: int,
    rng: np.random.Generator,
) -> Iterator[EvaluationFrame]:
    """Frames 1 s apart of every scene, the cars taking turns as ego, random teammates attacking."""
    turn = 0
    for seed in seeds:
        scene = IntersectionScene(seed)
        for frame in scene.frames(frames_per_scene, stride=FRAMES_PER_SECOND):
            ego_id = f"car-{turn % scene.car_agents + 1}"
            turn += 1
            teammates = sorted(set(scene.agents) - {ego_id})
            chosen = [str(name) for name in rng.choice(teammates, attackers, replace=False)]
            yield under_attack(detector, frame, ego_id, chosen, attack, rng)


def evaluate_bounds(
    detector: Detector,
    attack: Attack,
    *,
    seeds: Sequence[int],
    frames_per_scene: int = 5,
    attackers: int = 1,
    collaborators: int = 3,
    budgets: Sequence[int] = (7, 5, 3, 1),
    repeats: int = 10,
    seed: int = 0,
    tick: Callable[[], None] = lambda: None,
) -> BoundsReport:
    """Compute the table of bounds.

    Parameters
    ----------
    detector, attack
    seeds : sequence of int
        Scenes; take them from `robosac.scenes.splits.TEST_SEEDS`.
    frames_per_scene : int
    attackers : int
        Among the teammates of each frame, chosen at random, optimised jointly.
    collaborators : int
        s, the size of a hypothesis.
    budgets : sequence of int
        One row of Algorithm 1 for each, with independent draws as in the paper; one for the first of them where no
        subset is drawn twice in a frame; and one with the gateway's defaults, which choose the hypotheses' size too.
    repeats : int
        Runs of Algorithm 1 on each frame, so that the luck of its draws averages out; the fused passes are shared.
    seed : int
        Of everything random here.
    tick : callable
        Called after each frame.
    """
    ratio = attackers / TEAM_SIZE if attackers else ASSUMED_RATIO
    samplers = {
        f"Algorithm 1, N = {n}": SampleConsensus(ratio, sampling_budget=n, collaborators=collaborators, distinct=False)
        for n in budgets
    }
    samplers[f"no subset twice, N = {budgets[0]}"] = SampleConsensus(
        ratio, sampling_budget=budgets[0], collaborators=collaborators
    )
    samplers["gateway default"] = SampleConsensus(ratio)
    table = _Table(detector, collaborators, samplers, repeats)
    attack_rng = np.random.default_rng([seed, 0])
    frames = evaluation_frames(detector, seeds, frames_per_scene, attack, attackers, attack_rng)
    for index, frame in enumerate(frames):
        table.add(frame, [seed, 1, index])  # the same attacks, and each row the same luck, whatever else is evaluated
        tick()
    return table.report(attack.epsilon)


class DecodedOnce:
    """A prepared frame that decodes each subset once, posing as the detector that prepared it."""

    def __init__(self, detector: Detector, ego: Message, teammates: Mapping[str, Message]) -> None:
        self.info = detector.info
        self._prepared = detector.prepare(ego, teammates)
        self._boxes: dict[frozenset[str], FloatArray] = {}

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:  # noqa: ARG002 (always the same)
        """The frame itself."""
        return self

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset, decoded at most once."""
        key = frozenset(teammates)
        if key not in self._boxes:
            self._boxes[key] = self._prepared.detect(teammates)
        return self._boxes[key]


class _Table:
    def __init__(
        self, detector: Detector, collaborators: int, samplers: Mapping[str, SampleConsensus], repeats: int
    ) -> None:
        self._detector = detector
        self._s = collaborators
        self._samplers = samplers
        self._repeats = repeats
        self._frames = 0
        names = ["all benign", f"{collaborators} benign", *samplers, "ego only", "no defence"]
        self._ap = {name: AveragePrecision() for name in names}
        self._runs: dict[str, list[tuple[int, bool, bool]]] = {name: [] for name in samplers}
        self._refused: list[bool] = []
        self._missed: list[bool] = []
        self._magnitudes: list[float] = []

    def add(self, frame: EvaluationFrame, seed: Sequence[int]) -> None:
        benign = DecodedOnce(self._detector, frame.ego, frame.benign)
        received = DecodedOnce(self._detector, frame.ego, frame.received)
        team = list(frame.benign)
        for subset in combinations(team, self._s):
            self._ap[f"{self._s} benign"].add(benign.detect(subset), frame.truth)
        self._ap["all benign"].add(benign.detect(team), frame.truth)
        self._ap["ego only"].add(benign.detect(), frame.truth)
        self._ap["no defence"].add(received.detect(team), frame.truth)
        self._judge_all(received, frame)
        for name in self._samplers:
            for repeat in range(self._repeats):
                self._sample(received, frame, name, np.random.default_rng([*seed, repeat]))
        magnitudes = np.abs(np.concatenate([t.ravel() for m in frame.benign.values() for t in m.tensors.values()]))
        self._magnitudes.append(float(np.percentile(magnitudes, 95)))
        self._frames += 1

    def _judge_all(self, received: PreparedFrame, frame: EvaluationFrame) -> None:
        score = self._detector.info.consensus_score
        reference = at_least(received.detect(), score)
        for subset in combinations(frame.benign, self._s):
            verdict = compare(reference, at_least(received.detect(subset), score)).verdict
            if frame.attackers.isdisjoint(subset):
                self._refused.append(verdict is Verdict.DISSENSUS)
            else:
                self._missed.append(verdict is Verdict.CONSENSUS)

    def _sample(self, received: DecodedOnce, frame: EvaluationFrame, name: str, rng: np.random.Generator) -> None:
        result = fuse(received, self._samplers[name], frame.ego, frame.received, rng=rng)
        self._ap[name].add(result.boxes, frame.truth)
        infiltrated = not frame.attackers.isdisjoint(result.accepted)
        self._runs[name].append((result.sampling_steps, bool(result.accepted), infiltrated))

    def report(self, epsilon: float) -> BoundsReport:
        rows = []
        for name, ap in self._ap.items():
            runs = np.mean(self._runs[name], axis=0) if name in self._runs else (None, None, None)
            rows.append(BoundsRow(name, ap.at(0.5), ap.at(0.7), *(None if v is None else float(v) for v in runs)))
        return BoundsReport(
            rows=rows,
            frames=self._frames,
            false_alarm_rate=float(np.mean(self._refused)) if self._refused else None,
            miss_rate=float(np.mean(self._missed)) if self._missed else None,
            benign_hypotheses=len(self._refused),
            attacked_hypotheses=len(self._missed),
            perturbation_to_feature_ratio=epsilon / float(np.mean(self._magnitudes)),
        )
