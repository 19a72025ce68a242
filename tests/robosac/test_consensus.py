import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.boxes import pairwise_iou
from robosac.consensus import at_least, compare, match, overlaps
from tests.conftest import GOLDEN
from tests.robosac.rectangles import from_corners

EMPTY = np.empty((0, 5))
ROW = np.array([[10.0 * i, 0.0, 4.0, 2.0, 0.0] for i in range(10)])


def golden_cases():
    data = np.load(GOLDEN / "box_matching.npz")
    first1, first2 = np.cumsum(data["n1"]) - data["n1"], np.cumsum(data["n2"]) - data["n2"]
    area = data["n1"].astype(int) * data["n2"]
    first_iou = np.cumsum(area) - area
    for i, (n1, n2) in enumerate(zip(data["n1"], data["n2"], strict=True)):
        yield (
            from_corners(data["boxes1"][first1[i] : first1[i] + n1].reshape(-1, 4, 2)),
            from_corners(data["boxes2"][first2[i] : first2[i] + n2].reshape(-1, 4, 2)),
            data["iou"][first_iou[i] : first_iou[i] + area[i]].reshape(n1, n2),
            float(data["jaccard"][i]),
            int(data["n_matched"][i]),
        )


def test_agrees_with_the_published_implementation():
    both_empty = 0
    for reference, candidate, iou, jaccard, matched in golden_cases():
        comparison = compare(reference, candidate)
        if len(reference) == len(candidate) == 0:  # there, index 0; here, agreement without evidence
            both_empty += 1
            assert comparison.jaccard_index == 1.0
            continue
        np.testing.assert_allclose(pairwise_iou(reference, candidate), iou, atol=1e-6)
        assert comparison.jaccard_index == pytest.approx(jaccard, abs=1e-12)
        assert comparison.matched == matched
    assert both_empty == 1


def test_two_empty_perceptions_are_no_evidence():
    assert compare(EMPTY, EMPTY).verdict is Verdict.NO_EVIDENCE


@pytest.mark.parametrize(("reference", "candidate"), [(EMPTY, ROW), (ROW, EMPTY)])
def test_empty_against_something_is_dissensus(reference, candidate):
    comparison = compare(reference, candidate)
    assert (comparison.jaccard_index, comparison.verdict) == (0.0, Verdict.DISSENSUS)


@pytest.mark.parametrize(("seen", "verdict"), [(3, Verdict.CONSENSUS), (2, Verdict.DISSENSUS)])
def test_the_threshold_belongs_to_consensus(seen, verdict):
    comparison = compare(ROW[:seen], ROW, threshold=0.3)
    assert comparison.jaccard_index == seen / 10
    assert comparison.verdict is verdict


def test_matching_is_one_to_one():
    rows, columns = match(ROW[[0, 0, 0]], ROW[:1])
    assert (len(rows), columns.tolist()) == (1, [0])


def test_a_pair_counts_from_the_threshold_on():
    half = ROW[:1] * [[1, 1, 0.5, 1, 1]]
    assert len(match(ROW[:1], half, 0.5)[0]) == 1
    assert len(match(ROW[:1], half, 0.51)[0]) == 0


def test_a_wrong_argument_is_named():
    box = [[0.0, 0.0, 4.0, 2.0, 0.0]]
    for threshold in (0, -1, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"^threshold must be in \(0, 1\]"):
            compare(box, box, threshold)
        with pytest.raises(ValueError, match=r"^iou_threshold must be in \(0, 1\]"):
            match(box, box, threshold)
    with pytest.raises(ValueError, match=r"^reference must be of shape"):
        compare(box[0], box)
    with pytest.raises(ValueError, match=r"^candidate must be of shape"):
        match(box, box[0])
    with pytest.raises(ValueError, match=r"^boxes must be of shape \(n, 6\+\)"):
        at_least(box, 0.5)


def test_lists_are_compared_like_arrays():
    box = [[0.0, 0.0, 4.0, 2.0, 0.0]]
    assert compare(box, box) == compare(np.array(box), np.array(box, dtype=np.float32))
    assert compare([], box).verdict is Verdict.DISSENSUS
    assert compare([], []).verdict is Verdict.NO_EVIDENCE


def test_no_matching_of_the_golden_data_is_larger_than_the_largest():
    with np.load(GOLDEN / "box_matching.npz") as data:
        matched, largest, branch = data["n_matched"], data["max_cardinality"], data["branch"]
    ours = np.array([len(match(reference, candidate)[0]) for reference, candidate, *_ in golden_cases()])
    assert ours.tolist() == matched.tolist()
    assert (ours <= largest).all()
    assert set(branch[ours < largest]) == {3}


@pytest.mark.parametrize(
    ("knows", "index", "verdict"),
    [(None, 0.2, "dissensus"), (100.0, 0.2, "dissensus"), (45.0, 0.4, "consensus"), (0.0, 1.0, "consensus")],
)
def test_of_what_the_reference_cannot_know_it_is_no_judge(knows, index, verdict):
    known = None if knows is None else lambda places: places[:, 0] < knows
    comparison = compare(ROW[:2], ROW, known=known)
    assert (comparison.jaccard_index, comparison.matched, comparison.verdict) == (pytest.approx(index), 2, verdict)
    away = ROW[2:] + [0.0, 30.0, 0.0, 0.0, 0.0]
    assert compare(ROW[:2], away, known=known).verdict == "dissensus"
    assert compare(ROW, ROW[:2], known=known).verdict == "dissensus"  # nor does it forget what it sees itself


def test_overlaps_found_together_are_those_of_each_candidate():
    rng = np.random.default_rng(0)
    candidates = [ROW[:size] + rng.normal(0.0, 0.6, (size, 5)) for size in (3, 0, 10, 1)]
    for candidate, iou in zip(candidates, overlaps(ROW, candidates), strict=True):
        np.testing.assert_array_equal(iou, pairwise_iou(ROW, candidate))
        assert compare(ROW, candidate, iou=iou) == compare(ROW, candidate)
    assert [each.shape for each in overlaps(EMPTY, candidates)] == [(0, 3), (0, 0), (0, 10), (0, 1)]


def test_an_overlap_that_is_known_is_not_computed_again():
    assert compare(ROW, ROW, iou=np.zeros((10, 10))).matched == 0
