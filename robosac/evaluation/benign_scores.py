"""What honest teammates look like to the consensus test: the calibration of `robosac.defenses.Conformal`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from robosac.answers import Verdict
from robosac.consensus import at_least, compare
from robosac.detectors import Detector
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene


def single_teammate_indices(
    detector: Detector, seeds: Sequence[int], tick: Callable[[], None] = lambda: None
) -> list[float]:
    """Jaccard indices of the ego fused with one honest teammate against the ego alone, ascending.

    One frame of every scene, the cars taking turns as ego, every teammate in turn; fusions without evidence are left
    out.

    Parameters
    ----------
    detector : Detector
    seeds : sequence of int
        Scenes.
    tick : callable
        Called after each scene.
    """
    indices = []
    for turn, seed in enumerate(seeds):
        scene = IntersectionScene(seed)
        messages = encode_all(detector, scene.frame(0))
        ego_id = f"car-{turn % scene.car_agents + 1}"
        frame = detector.prepare(messages.pop(ego_id), messages)
        own = at_least(frame.detect(), detector.info.consensus_score)
        for name in messages:
            comparison = compare(own, at_least(frame.detect((name,)), detector.info.consensus_score))
            if comparison.verdict is not Verdict.NO_EVIDENCE:
                indices.append(comparison.jaccard_index)
        tick()
    return sorted(indices)
