import numpy as np
import pytest
import torch

from robosac.detectors.decoding import MAX_PEAKS, box_codes, cell_centres, decode_boxes

TRUTH = np.array([[10.3, -7.8, 4.4, 1.9, 0.6], [-20.1, 15.0, 8.0, 2.5, -1.2]])


def heads(boxes, scores):
    xs, ys = cell_centres()
    logits = torch.full((64, 64), -10.0)
    codes = torch.zeros(6, 64, 64)
    for box, score in zip(boxes, scores, strict=True):
        row, column = int((box[1] + 32) // 1), int((box[0] + 32) // 1)
        logits[row, column] = float(np.log(score / (1 - score)))
        at = (slice(row, row + 1), slice(column, column + 1))
        codes[:, row, column] = torch.from_numpy(box_codes(box, xs[at].ravel(), ys[at].ravel())[:, 0])
    return logits, codes


def test_what_is_encoded_is_decoded():
    boxes = decode_boxes(*heads(TRUTH, [0.6, 0.9]), 0.1)
    np.testing.assert_allclose(boxes, np.column_stack([TRUTH, [0.6, 0.9]])[::-1], atol=1e-5)


def test_boxes_below_the_threshold_are_left_out():
    assert len(decode_boxes(*heads(TRUTH, [0.09, 0.11]), 0.1)) == 1
    assert decode_boxes(*heads([], []), 0.1).shape == (0, 6)


def test_the_egos_own_body_is_left_out():
    assert len(decode_boxes(*heads(np.array([[0.4, -0.4, 4.5, 1.9, 0.0]]), [0.9]), 0.1)) == 0


def test_overlapping_boxes_are_suppressed():
    twice = np.array([[10.2, 0.5, 4.5, 1.9, 0.0], [12.2, 0.5, 4.5, 1.9, 0.0]])
    boxes = decode_boxes(*heads(twice, [0.5, 0.8]), 0.1)
    assert boxes[:, 0].tolist() == pytest.approx([12.2])


def test_a_flooded_map_is_bounded_and_finite(rng):
    logits = torch.from_numpy(rng.normal(0.0, 500.0, (64, 64)).astype(np.float32))
    codes = torch.from_numpy(rng.normal(0.0, [[[1.0]]] * 2 + [[[1e4]]] * 4, (6, 64, 64)).astype(np.float32))
    boxes = decode_boxes(logits, codes, 0.1)
    assert len(boxes) <= MAX_PEAKS
    assert np.isfinite(boxes).all()
    assert np.abs(boxes[:, :2]).max() <= 32.0


def test_of_too_many_peaks_the_best_are_decoded():
    logits = torch.full((64, 64), -10.0)
    logits[::2, ::2] = torch.linspace(-1.0, 1.0, 1024).reshape(32, 32)
    best = decode_boxes(logits, torch.zeros(6, 64, 64), 0.1)
    assert best[0, 5] == pytest.approx(1 / (1 + np.exp(-1.0)))


def test_what_counts_is_where_the_box_is_not_where_its_peak_is():
    xs, ys = cell_centres()
    logits, codes = torch.full((64, 64), -10.0), torch.zeros(6, 64, 64)
    for (row, column), centre in {(32, 40): (0.5, 0.5), (10, 10): (-40.0, -20.0), (32, 32): (5.0, 0.0)}.items():
        logits[row, column] = 3.0
        codes[0, row, column] = centre[0] - xs[row, column]
        codes[1, row, column] = centre[1] - ys[row, column]
    np.testing.assert_allclose(decode_boxes(logits, codes, 0.1)[:, :2], [[5.0, 0.0]], atol=1e-5)
