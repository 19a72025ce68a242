"""Choices made on validation scenes: the feature gain and the score from which a box takes part in the consensus
test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from robosac.attacks import PGD
from robosac.consensus import DEFAULT_THRESHOLD, at_least, compare
from robosac.detectors import EmbeddedDetector, Preparer
from robosac.detectors.network import MeanFusionNetwork
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import EvaluationFrame, evaluation_frames
from robosac.scenes.intersection import Synthetic

GAINS = (1.0, 0.7, 0.5, 0.4, 0.35, 0.3, 0.25, 0.2)
CONSENSUS_SCORES = (0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
SCORE_THRESHOLD = 0.1
HARM = 0.25
SCENES = 20
FRAMES_PER_SCENE = 3
HYPOTHESIS = 3

Trial = tuple[Preparer, list[EvaluationFrame]]
"""A detector, and frames in which it is attacked."""


@dataclass(frozen=True)
class OperatingPoint:
    """What validation chose, and the figures behind it."""

    feature_gain: float
    """What messages are multiplied by, so that a perturbation of 0.5 harms as much as in the literature."""
    score_threshold: float
    """Least score of an answered box."""
    consensus_score: float
    """Least score of a box in the consensus test."""
    figures: dict[str, float]
    """Average precision at IoU 0.5 of ego only, all benign and no defence; consensus margin, false alarm and miss rate.
    """


def validation_frames(network: MeanFusionNetwork, gain: float) -> Trial:
    """A detector with this gain, and 60 frames of 20 validation scenes with one PGD attacker of five."""
    detector = EmbeddedDetector.from_network(network, gain, SCORE_THRESHOLD, SCORE_THRESHOLD)
    scenes, rng = Synthetic().scenes("validation")[:SCENES], np.random.default_rng(0)
    return detector, list(filter(None, evaluation_frames(detector, scenes, FRAMES_PER_SCENE, PGD(), 1, rng)))


def choose_operating_point(
    attacked: Callable[[float], Trial],
    tick: Callable[[], None],
    gains: Sequence[float] = GAINS,
    harm: float = HARM,
) -> OperatingPoint:
    """Choose gain and consensus score.

    The network is positively homogeneous where the message is taken. So a gain changes no perception, only what a
    perturbation of a given size means.

    1. The gain is the largest at which the attack (PGD: 15 steps of 0.1 within 0.5) brings the undefended fusion 0.25
       of AP50 below the ego alone; in the paper it is 0.24.
    2. At that gain, the consensus score keeps both kinds of hypotheses farthest from the consensus threshold. It
       maximises the smaller of two distances: of the benign ones' 1st percentile, and of the attacked ones' 99th.

    Parameters
    ----------
    attacked : callable
        Gives the detector with a gain, and frames in which it is attacked; see `validation_frames`.
    tick : callable
        Called after each gain tried.
    gains : sequence of float
        Tried in this order.
    harm : float
        How far below the ego alone the undefended fusion must fall, in AP50.

    Raises
    ------
    ValueError
        If not even the smallest gain lets the attack do that much harm.
    """
    figures: dict[str, float] = {}
    for gain in gains:
        detector, frames = attacked(gain)
        figures = _average_precision(detector, frames)
        tick()
        if figures["no_defence_ap50"] <= figures["ego_only_ap50"] - harm:
            score, errors = _consensus_score(detector, frames)
            return OperatingPoint(gain, SCORE_THRESHOLD, score, {**figures, **errors})
    raise ValueError(f"at no gain down to {gains[-1]} does the attack harm by {harm} of AP50: {figures}")


def _average_precision(detector: Preparer, frames: list[EvaluationFrame]) -> dict[str, float]:
    ap = {name: AveragePrecision() for name in ("ego_only_ap50", "all_benign_ap50", "no_defence_ap50")}
    for frame in frames:
        team = list(frame.benign)
        benign = detector.prepare(frame.ego, frame.benign)
        ap["ego_only_ap50"].add(benign.detect(), frame.truth)
        ap["all_benign_ap50"].add(benign.detect(team), frame.truth)
        ap["no_defence_ap50"].add(detector.prepare(frame.ego, frame.teammates).detect(team), frame.truth)
    return {name: value.at(0.5) for name, value in ap.items()}


def _consensus_score(detector: Preparer, frames: list[EvaluationFrame]) -> tuple[float, dict[str, float]]:
    benign: dict[float, list[float]] = {score: [] for score in CONSENSUS_SCORES}
    attacked: dict[float, list[float]] = {score: [] for score in CONSENSUS_SCORES}
    for frame in frames:
        received = detector.prepare(frame.ego, frame.teammates)
        ego_only = received.detect()
        for subset in combinations(frame.teammates, HYPOTHESIS):
            fused = received.detect(subset)
            indices = benign if frame.attackers.isdisjoint(subset) else attacked
            for score in CONSENSUS_SCORES:
                comparison = compare(at_least(ego_only, score), at_least(fused, score))
                indices[score].append(comparison.jaccard_index)

    def margin(score: float) -> float:
        low, high = np.percentile(benign[score], 1), np.percentile(attacked[score], 99)
        return float(min(low - DEFAULT_THRESHOLD, DEFAULT_THRESHOLD - high))

    best = max(CONSENSUS_SCORES, key=margin)
    return best, {
        "consensus_margin": margin(best),
        "false_alarm_rate": float(np.mean(np.array(benign[best]) < DEFAULT_THRESHOLD)),
        "miss_rate": float(np.mean(np.array(attacked[best]) >= DEFAULT_THRESHOLD)),
    }
