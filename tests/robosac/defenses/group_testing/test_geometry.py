import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.defenses.group_testing.geometry import Said, changes, come_and_gone, crowd, followed, measure
from tests.robosac.defenses.group_testing.conversing import SEEN


def said(larger, real=None, vouched=None, in_place=None):
    """What others say of `SEEN`, and of a larger fusion; by default all of `SEEN` is real, and no more is said."""
    nothing = np.zeros(len(larger), dtype=bool)
    return Said(
        np.ones(len(SEEN), dtype=bool) if real is None else real,
        nothing if vouched is None else vouched,
        nothing if in_place is None else in_place,
    )


def test_what_stays_is_no_loss_and_nothing_new():
    pair = measure(SEEN, SEEN)
    assert (pair.loss, pair.novelty) == (pytest.approx(0.0), 0)


def test_what_vanishes_is_loss():
    assert measure(SEEN, SEEN[:6]).loss == pytest.approx(0.25)
    assert measure(SEEN, SEEN[:0]).loss == 1.0


def test_what_moves_is_loss_and_not_new():
    moved = SEEN + [2.0, 0, 0, 0, 0, 0]
    pair = measure(SEEN, moved)
    assert (pair.loss, pair.novelty) == (pytest.approx(2 / 3), 0)


def test_what_was_nowhere_is_new_if_it_is_claimed_with_confidence():
    far = SEEN[:3] + [0, 30.0, 0, 0, 0, 0]
    assert measure(SEEN, np.vstack([SEEN, far])).novelty == 3
    faint = far * [1, 1, 1, 1, 1, 0.2]
    assert measure(SEEN, np.vstack([SEEN, faint])).novelty == 0


def test_it_is_told_which_boxes_are_lost_moved_and_added():
    pushed = SEEN[:6] + np.array([2.0, 0, 0, 0, 0, 0]) * (np.arange(6) == 1)[:, None]
    far = SEEN[:2] + [0, 30.0, 0, 0, 0, 0]
    pair = measure(SEEN, np.vstack([pushed, far]))
    places = pair.compared.places()
    np.testing.assert_array_equal(places["lost"], SEEN[6:, :2])
    np.testing.assert_array_equal(places["moved"], SEEN[1:2, :2])
    np.testing.assert_array_equal(places["added"], far[:, :2])
    assert pair.novelty == len(places["added"])
    assert {name: len(of) for name, of in measure(SEEN, SEEN).compared.places().items()} == {
        "lost": 0, "moved": 0, "added": 0,
    }  # fmt: skip
    real = np.arange(8) != 6
    places = measure(SEEN, pushed, said(pushed, real=real, vouched=None)).compared.places()
    np.testing.assert_array_equal(places["lost"], SEEN[7:, :2])


def test_it_is_told_which_boxes_came_and_went():
    before, now = kept(SEEN[:6]), kept(SEEN[2:])
    came, gone = come_and_gone(before, now)
    np.testing.assert_allclose(came[:, :2], kept(SEEN[6:])[:, :2])
    np.testing.assert_allclose(gone[:, :2], kept(SEEN[:2])[:, :2])
    assert changes(before, now) == 4
    at_last = kept(SEEN[7:])[0, :2]
    came, gone = come_and_gone(before, now, lambda boxes: (boxes[:, :2] == at_last).all(axis=1))
    np.testing.assert_allclose(came[:, :2], kept(SEEN[6:7])[:, :2])
    assert (len(gone), changes(before, now, lambda boxes: (boxes[:, :2] == at_last).all(axis=1))) == (2, 3)


def test_what_somebody_else_vouches_for_is_not_new():
    more = np.vstack([SEEN, SEEN[:3] + [0, 30.0, 0, 0, 0, 0]])
    assert measure(SEEN, more, said(more)) == measure(SEEN, more)
    vouched = np.arange(len(more)) >= len(more) - 2
    assert measure(SEEN, more, said(more, vouched=vouched)).novelty == 1
    assert measure(SEEN, more, said(more, vouched=vouched)).loss == measure(SEEN, more).loss


def test_a_box_that_others_see_in_its_place_is_hardly_lost():
    """Where the detector is unsure how long a vehicle is, honest fusions differ."""
    shorter, moved = SEEN * [1, 1, 0.6, 1, 1, 1], SEEN + [2.0, 0, 0, 0, 0, 0]
    there = np.ones(len(SEEN), dtype=bool)
    assert measure(SEEN, shorter).loss == pytest.approx(0.4)
    assert measure(SEEN, shorter, said(SEEN)).loss == pytest.approx(0.4)
    assert measure(SEEN, shorter, said(SEEN, in_place=there)).loss == pytest.approx(0.1)
    assert measure(SEEN, SEEN, said(SEEN, in_place=there)).loss == pytest.approx(0.0)
    assert measure(SEEN, moved, said(SEEN, in_place=there)).loss == pytest.approx(2 / 3)  # too far to be the same box
    assert measure(SEEN, SEEN[:0], said(SEEN[:0], in_place=there[:0])).loss == 1.0


def test_a_box_that_nobody_else_supports_is_no_loss():
    """A detector shows what is not there, too."""
    real = np.arange(len(SEEN)) < 6
    assert measure(SEEN, SEEN[:5]).loss == pytest.approx(3 / 8)
    assert measure(SEEN, SEEN[:5], said(SEEN[:5], real=real)).loss == pytest.approx(1 / 6)
    assert measure(SEEN, SEEN, said(SEEN, real=real & (np.arange(len(SEEN)) < 1))) is None


def test_two_few_witnesses_are_no_evidence():
    faint = SEEN * [1, 1, 1, 1, 1, 0.4]
    assert measure(SEEN[:1], SEEN) is None
    assert measure(faint, SEEN) is None


def kept(boxes=SEEN, pose=(0.0, 0.0, 0.0, 0.0)):
    return followed(boxes, pose_matrix(*pose))


def test_nothing_changes_for_an_ego_that_drives_past():
    """What stands still in the world moves in the ego's frame."""
    driven = SEEN - [5.0, 0, 0, 0, 0, 0]
    assert changes(kept(), kept(driven, (5.0, 0.0, 0.0, 0.0))) == 0
    assert changes(kept(), kept(driven)) == 2 * len(SEEN)


def test_vehicles_drive_along_themselves_and_not_sideways():
    forward, sideways, turned = SEEN + [4.4, 0, 0, 0, 0, 0], SEEN + [0, 0.9, 0, 0, 0, 0], SEEN + [0, 0, 0, 0, 0.5, 0]
    assert changes(kept(), kept(forward)) == 0
    assert changes(kept(), kept(sideways)) == 2 * len(SEEN)
    assert changes(kept(), kept(turned)) == 2 * len(SEEN)
    backward = SEEN + [0, 0, 0, 0, np.pi, 0]
    assert changes(kept(), kept(backward)) == 0
    north = SEEN * [0, 1, 1, 1, 1, 1] + [0, 0, 0, 0, np.pi / 2, 0]
    assert changes(kept(north[:1]), kept(north[:1] + [0, 4.4, 0, 0, 0, 0])) == 0
    assert changes(kept(north[:1]), kept(north[:1] + [4.4, 0, 0, 0, 0, 0])) == 2


@pytest.mark.parametrize(("score", "came", "went", "counted"), [(0.6, 2, 2, 2), (0.4, 2, 0, 2), (0.2, 0, 0, 0)])
def test_what_comes_and_goes_counts_from_a_score_on(score, came, went, counted):
    more = np.vstack([SEEN, SEEN[:2] * [1, 1, 1, 1, 1, 0] + [0, 40.0, 0, 0, 0, score]])
    assert changes(kept(), kept(more)) == came
    assert changes(kept(more), kept()) == went
    assert crowd(kept(more)) == len(SEEN) + counted


def test_what_was_hardly_there_before_has_not_come():
    faint = SEEN * [1, 1, 1, 1, 1, 0] + [0, 0, 0, 0, 0, 0.15]
    assert changes(kept(faint), kept()) == 0
    assert changes(kept(), kept(faint)) == 0
    assert changes(kept(faint * [1, 1, 1, 1, 1, 0.5]), kept()) == len(SEEN)


def test_rounding_does_not_turn_a_box_around():
    west = SEEN + [0, 0, 0, 0, np.pi, 0]
    np.testing.assert_array_equal(kept(west + [0, 0, 0, 0, 1e-9, 0]), kept(west - [0, 0, 0, 0, 1e-9, 0]))
    assert changes(kept(west), kept(west)) == 0


def test_nothing_changes_where_there_is_nothing():
    assert changes(kept(SEEN[:0]), kept(SEEN[:0])) == 0
    assert changes(kept(SEEN[:0]), kept()) == len(SEEN)


def test_what_comes_or_goes_where_others_see_a_vehicle_is_not_made_up():
    here = kept()
    assert changes(here, here[1:]) == changes(here[1:], here) == 1
    for real, counted in ((True, 0), (False, 1)):
        seen = []

        def stands(boxes, real=real, seen=seen):
            seen.append(boxes)
            return np.full(len(boxes), real)

        assert changes(here, here[1:], stands) == changes(here[1:], here, stands) == counted
        assert all(np.array_equal(boxes, here[:1]) for boxes in seen)
