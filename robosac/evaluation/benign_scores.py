"""What honest teammates look like to the consensus test: the calibration of `robosac.defenses.Conformal`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from robosac.answers import Verdict
from robosac.consensus import at_least, compare
from robosac.detectors import Detector
from robosac.evaluation.frames import encode_all
from robosac.scenes import Scene, whose_turn


def single_teammate_indices(
    detector: Detector, scenes: Sequence[Scene], tick: Callable[[], None] = lambda: None
) -> list[float]:
    """Jaccard indices of the ego fused with one honest teammate against the ego alone, ascending.

    The first frame of every scene counts, and every teammate in it; the scenes' vehicles take turns as ego. Fusions
    without evidence are left out. ``tick`` is called after each scene.
    """
    indices = []
    for turn, scene in enumerate(scenes):
        first = scene.frame(0)
        ego_id = whose_turn(scene, turn, first)
        messages = encode_all(detector, first)
        frame = detector.prepare(messages.pop(ego_id), messages)
        own = at_least(frame.detect(), detector.info.consensus_score)
        for name in messages:
            comparison = compare(own, at_least(frame.detect((name,)), detector.info.consensus_score))
            if comparison.verdict is not Verdict.NO_EVIDENCE:
                indices.append(comparison.jaccard_index)
        tick()
    return sorted(indices)
