import numpy as np
import pytest

from robosac.boxes import from_units, from_world, in_units, pose_matrix, to_world
from robosac.previous import FOLLOWED_M, PreviousAnswer

WORLD = np.array(
    [
        [0.0, 0.0, 4.5, 1.9, 0.3, 0.9],
        [8.0, 2.0, 4.2, 1.8, -2.0, 0.8],
        [-9.0, 12.0, 8.0, 2.4, 1.6, 0.4],
    ]
)
THEN, NOW, NEXT = pose_matrix(5.0, 1.0, 1.7, 0.2), pose_matrix(6.5, 1.2, 1.7, 0.25), pose_matrix(8.0, 1.5, 1.7, 0.3)

ROUNDED = 0.0051 * 2**0.5
"""What is kept of a box is rounded to a centimetre."""


def shifted(by):
    moved = WORLD.copy()
    moved[:, :2] += by
    return moved


def test_boxes_stand_still_in_the_world_until_their_motion_is_known():
    before = PreviousAnswer.of(3, THEN, from_world(WORLD, THEN))
    np.testing.assert_allclose(before.expected_at(NOW), from_world(WORLD, NOW), atol=ROUNDED)


def test_boxes_move_on_as_they_moved_before_whatever_the_ego_does():
    by = np.array([[1.6, 0.4], [0.0, 0.0], [-0.3, 1.8]])
    before = PreviousAnswer.of(3, THEN, from_world(WORLD, THEN))
    moved = shifted(by)[::-1]  # in another order
    now = PreviousAnswer.of(4, NOW, from_world(moved, NOW), before)
    np.testing.assert_allclose(now.expected_at(NEXT), from_world(shifted(2 * by)[::-1], NEXT), atol=3 * ROUNDED)


@pytest.mark.parametrize("frame", [3, 5, 2])
def test_motion_is_not_taken_across_a_gap(frame):
    before = PreviousAnswer.of(3, THEN, from_world(WORLD, THEN))
    now = PreviousAnswer.of(frame, NOW, from_world(shifted([1.0, 0.0]), NOW), before)
    assert not now.motion.any()


def test_a_box_that_would_have_leapt_is_a_new_one():
    before = PreviousAnswer.of(3, THEN, from_world(WORLD[:1], THEN))
    for leap, known in ((FOLLOWED_M - 0.01, True), (FOLLOWED_M + 0.01, False)):
        now = PreviousAnswer.of(4, NOW, from_world(shifted([leap, 0.0])[:1], NOW), before)
        assert bool(now.motion.any()) is known


def test_empty_answers_are_remembered_too():
    nothing = np.empty((0, 6))
    before = PreviousAnswer.of(3, THEN, nothing)
    now = PreviousAnswer.of(4, NOW, from_world(WORLD, NOW), before)
    assert not now.motion.any()
    assert PreviousAnswer.of(5, NEXT, nothing, now).expected_at(NEXT).shape == (0, 6)


def test_what_is_kept_is_what_a_log_holds_of_it():
    seen = from_world(WORLD, THEN)
    kept = PreviousAnswer.of(3, THEN, seen)
    again = PreviousAnswer.of(3, THEN, from_units(in_units(seen)))
    assert (kept.boxes == again.boxes).all()
    assert (kept.boxes != PreviousAnswer(3, to_world(seen, THEN), kept.motion).boxes).any()
