import math

import numpy as np
import pytest

from robosac.evaluation import AveragePrecision
from tests.conftest import GOLDEN
from tests.robosac.rectangles import from_corners

TRUTH = np.array([[10.0 * i, 0.0, 4.0, 2.0, 0.0] for i in range(4)])
NONE = np.empty((0, 6))


def scored(boxes, scores):
    return np.column_stack([boxes, scores])


@pytest.mark.parametrize("case", range(7))
def test_agrees_with_the_published_implementation(case):
    data = np.load(GOLDEN / "ap_eval.npz")
    detections, truths = data[f"{case}_dets"], data[f"{case}_gts"]
    ap = AveragePrecision()
    d = t = 0
    for n_det, n_gt in zip(data[f"{case}_n_det"], data[f"{case}_n_gt"], strict=True):
        found, true = detections[d : d + n_det], truths[t : t + n_gt]
        ap.add(scored(from_corners(found[:, :8].reshape(-1, 4, 2)), found[:, 8]), from_corners(true.reshape(-1, 4, 2)))
        d, t = d + n_det, t + n_gt
    assert [ap.at(0.5), ap.at(0.7)] == pytest.approx(data[f"{case}_ap"].tolist(), abs=1e-6)
    assert [ap.curve(iou)[1][-1] for iou in (0.5, 0.7)] == pytest.approx(data[f"{case}_recall_last"].tolist())


def test_a_frame_without_detections_still_counts_with_its_true_boxes():
    ap = AveragePrecision()
    ap.add(scored(TRUTH, [0.9] * 4), TRUTH)
    assert ap.at(0.5) == 1.0
    ap.add(NONE, TRUTH)
    assert ap.at(0.5) == 0.5


def test_a_frame_without_true_boxes_counts_its_detections_as_false():
    ap = AveragePrecision()
    ap.add(scored(TRUTH, [0.9] * 4), TRUTH[:0])
    ap.add(scored(TRUTH, [0.5] * 4), TRUTH)
    assert ap.at(0.5) == 0.5


def test_a_true_box_is_found_once():
    ap = AveragePrecision()
    ap.add(scored(TRUTH[[0, 0]], [0.9, 0.8]), TRUTH[:1])
    precision, recall = ap.curve(0.5)
    assert precision.tolist() == [1.0, 0.5]
    assert recall.tolist() == [1.0, 1.0]
    assert ap.at(0.5) == 1.0


def test_a_pair_counts_from_the_threshold_on():
    ap = AveragePrecision()
    ap.add(scored(TRUTH[:1] * [[1, 1, 0.5, 1, 1]], [0.9]), TRUTH[:1])
    assert (ap.at(0.5), ap.at(0.51)) == (1.0, 0.0)


@pytest.mark.parametrize("threshold", [0.0, -1.0, 1.1, float("nan")])
def test_thresholds_without_meaning_are_refused(threshold):
    with pytest.raises(ValueError, match="iou_threshold"):
        AveragePrecision().at(threshold)


def test_scores_rank_across_frames():
    ap = AveragePrecision()
    ap.add(scored(TRUTH[:1] + [[0, 50, 0, 0, 0]], [0.99]), TRUTH[:1])
    ap.add(scored(TRUTH[:1], [0.5]), TRUTH[:1])
    assert ap.at(0.5) == pytest.approx(0.25)


def test_without_any_truth_there_is_no_average_precision():
    assert math.isnan(AveragePrecision().at(0.5))


@pytest.mark.parametrize("threshold", [0.5, 0.7])
def test_groups_are_left_out_in_turn(threshold, rng):
    frames = []
    for group in (0, 1, 2, 2, 7):
        moved = TRUTH[rng.integers(0, 4, 9)] + rng.normal(0, 0.4, (9, 5)) * [1, 1, 0, 0, 0.1]
        frames.append((group, scored(moved, rng.random(9).round(1)), TRUTH[: 1 + group % 4]))
    frames.append((1, NONE, TRUTH))

    def precision(without=None):
        ap = AveragePrecision()
        for group, found, truth in frames:
            if group != without:
                ap.add(found, truth, group)
        return ap

    (left_out,) = precision().leaving_out(threshold)
    assert left_out == pytest.approx([precision(group).at(threshold) for group in (0, 1, 2, 7)], abs=1e-12)
    assert len(set(left_out)) == 4


def test_nothing_is_left_of_a_single_group():
    ap = AveragePrecision()
    ap.add(scored(TRUTH, [0.9] * 4), TRUTH)
    assert np.isnan(ap.leaving_out(0.5, 0.7)).tolist() == [[True], [True]]
