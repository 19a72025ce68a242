import numpy as np

from robosac.evaluation.objects import Shown
from robosac.evaluation.standing import NONE, TrueBoxes, true_boxes

TRUTH = np.array([[10.0 * n, 0.0, 4.5, 1.9, 0.0] for n in range(4)])


def boxes(*places):
    return np.array([[x, y, 4.5, 1.9, 0.0, 0.9] for x, y in places]).reshape(-1, 6)


def test_only_boxes_that_match_a_vehicle_count():
    shown = Shown(
        boxes((0, 0), (10, 0.3), (20, 9), (30, 0)),
        ("confirmed", "single_witness", "confirmed", "repaired"),
        boxes((20, 0.2), (5, 7)),
    )
    assert true_boxes(shown, TRUTH) == TrueBoxes(judged=4, confirmed=1, contradicted=1)


def test_where_nothing_is_known_or_there_nothing_counts():
    assert true_boxes(Shown(boxes((0, 0))), TRUTH) == NONE
    assert true_boxes(Shown(boxes((0, 0)), ("confirmed",), boxes((9, 0))), np.empty((0, 5))) == NONE
    assert true_boxes(Shown(boxes(), ()), TRUTH) == NONE
