import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.detectors import Message
from robosac.evaluation.frames import EvaluationFrame
from robosac.training.validation import choose_operating_point


def boxes(score, *ys):
    """A row of 20 boxes along x for each y."""
    return np.array([[10.0 * i, y, 4.0, 2.0, 0.0, score] for y in ys for i in range(20)])


TRUTH = boxes(0.9, 5.0)
EGO_SEES = TRUTH[:12]
WEAK_CLUTTER = boxes(0.22, -15.0, -25.0, -35.0)
FAKES = boxes(0.45, -45.0, -55.0, -65.0)[:57]
EGO = Message(pose_matrix(0, 0, 0, 0), {})
TEAM = dict.fromkeys("abcde", EGO)
LEFT = {1.0: 12, 0.7: 10, 0.5: 9, 0.4: 8, 0.35: 6}
"""True boxes of 20 that the attacked team still finds, by gain."""


class FakeDetector:
    """Below a score of 0.25 honest fusions are cluttered; above 0.45 attacked ones look honest."""

    def __init__(self, gain):
        self.left = LEFT.get(gain, 0)

    def prepare(self, ego, teammates):
        return self

    def detect(self, teammates=()):
        if len(teammates) == len(TEAM):
            return TRUTH[: self.left]
        if not teammates:
            return EGO_SEES
        return np.vstack([EGO_SEES, FAKES if "a" in teammates else WEAK_CLUTTER])


@pytest.fixture
def tried():
    """Gains that were tried."""
    return []


@pytest.fixture
def attacked(tried):
    def trial(gain):
        tried.append(gain)
        return FakeDetector(gain), [EvaluationFrame(FakeDetector(gain), EGO, TEAM, TEAM, frozenset("a"), TRUTH[:, :5])]

    return trial


def test_the_largest_gain_that_harms_enough_is_taken(attacked, tried):
    ticks = []
    point = choose_operating_point(attacked, lambda: ticks.append(1))
    assert point.feature_gain == tried[-1] == 0.35
    assert len(ticks) == len(tried) == 5
    assert point.figures["ego_only_ap50"] == pytest.approx(0.6)
    assert point.figures["no_defence_ap50"] == pytest.approx(0.3)


def test_the_score_farthest_from_both_errors_is_taken(attacked):
    point = choose_operating_point(attacked, lambda: None)
    assert 0.22 < point.consensus_score <= 0.45
    assert point.figures["false_alarm_rate"] == point.figures["miss_rate"] == 0.0
    assert point.figures["consensus_margin"] == pytest.approx(0.3 - 4 / 23)


def test_a_detector_that_cannot_be_harmed_is_reported(attacked):
    with pytest.raises(ValueError, match=r"at no gain down to 0\.7"):
        choose_operating_point(attacked, lambda: None, gains=(1.0, 0.7))
