import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.detectors import Message
from robosac.evaluation.frames import EvaluationFrame
from robosac.training import validation
from robosac.training.validation import choose_operating_point

BOXES = np.array([[10.0 * i, 5.0, 4.0, 2.0, 0.0, 0.9] for i in range(1, 5)])
WEAK_CLUTTER = np.array([[10.0 * i, -15.0, 4.0, 2.0, 0.0, 0.22] for i in range(-8, 9)])
FAKES = np.array([[10.0 * i, -5.0, 4.0, 2.0, 0.0, 0.45] for i in range(-9, 10)])
EGO = Message(pose_matrix(0, 0, 0, 0), {})
TEAM = dict.fromkeys("abcde", EGO)


class FakeDetector:
    """Below a score of 0.25 honest fusions are cluttered; above 0.45 attacked ones look honest."""

    def prepare(self, ego, teammates):
        return self

    def detect(self, teammates=()):
        if not teammates:
            return BOXES
        return np.vstack([BOXES, FAKES]) if "a" in teammates else np.vstack([BOXES, WEAK_CLUTTER])


@pytest.fixture
def fakes(monkeypatch):
    """AP50 under attack by gain; the rest is fixed."""
    harm = {1.0: 0.6, 0.7: 0.5, 0.5: 0.42, 0.4: 0.36, 0.35: 0.34}
    gains = []

    def from_network(network, gain, *scores):
        gains.append(gain)
        return FakeDetector()

    frame = EvaluationFrame(FakeDetector(), EGO, TEAM, TEAM, frozenset("a"), BOXES[:, :5])
    monkeypatch.setattr(validation.EmbeddedDetector, "from_network", from_network)
    monkeypatch.setattr(validation, "evaluation_frames", lambda *_: iter([frame]))
    figures = lambda *_: {"ego_only_ap50": 0.6, "no_defence_ap50": harm.get(gains[-1], 0.0)}  # noqa: E731
    monkeypatch.setattr(validation, "_average_precision", figures)
    return gains


def test_the_largest_gain_that_harms_enough_is_taken(fakes):
    ticks = []
    point = choose_operating_point(None, lambda: ticks.append(1))
    assert point.feature_gain == fakes[-1] == 0.35
    assert len(ticks) == len(fakes) == 5
    assert point.figures["no_defence_ap50"] == 0.34


def test_the_score_farthest_from_both_errors_is_taken(fakes):
    point = choose_operating_point(None, lambda: None)
    assert 0.22 < point.consensus_score <= 0.45
    assert point.figures["false_alarm_rate"] == point.figures["miss_rate"] == 0.0
    assert point.figures["consensus_margin"] == pytest.approx(0.3 - 4 / 23)


def test_a_detector_that_cannot_be_harmed_is_reported(fakes):
    with pytest.raises(ValueError, match=r"at no gain down to 0\.7"):
        choose_operating_point(None, lambda: None, gains=(1.0, 0.7))
