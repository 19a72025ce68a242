"""What others say of a box, and when that is a contradiction."""

import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.defenses.group_testing.claims import AROUND_M, DENIES, SUPPORTS, Claims, two_witnesses
from robosac.testimony import MOST
from tests.robosac.testifying import SPREAD_M, saying

PLACE = (10.0, 4.0)
BOX = np.array([[*PLACE, 4.5, 1.9, 0.3, 0.9]])
YES, NO = 6.0, -8.0


def claim(ego, *teammates):
    """What the ego and teammates "a", "b", ... say of one box."""
    said = dict(zip(("", *"abcde"), (ego, *teammates), strict=False))
    return Claims.of(BOX, saying({name: [(*PLACE, value)] for name, value in said.items()}))


@pytest.mark.parametrize(
    ("said", "contradicted"),
    [
        ((NO, YES), True),  # the ego's word is enough
        ((NO, 0.0, YES), True),
        ((NO, YES, YES), True),
        ((NO, YES, YES, YES), False),  # three do not lie together: the ego itself may be late
        ((NO, NO, YES, YES, YES), False),
        ((-5.0, YES, YES), False),  # if it is clear
        ((0.0, NO, YES), False),  # one against one
        ((0.0, NO, NO, YES), True),
        ((-1.5, NO, NO, YES, YES), True),  # who supports it most may have made it up
        ((0.0, NO, NO, NO, YES, YES), True),
        ((0.0, NO, NO, YES, YES), False),  # two may lie together
        ((0.0, NO, NO, YES, YES, YES), False),
        ((YES, NO, NO, NO, 0.0), False),  # the ego sees it
        ((0.0, 0.0, 0.0), False),
        ((0.0, -5.0, 0.0, -0.5), False),  # too little in all
        ((0.0, -4.5, -4.5, YES), True),
        ((-2.5, -2.5, -2.5, YES), False),  # nobody denies it by itself
    ],
)
def test_a_box_is_contradicted_by_the_ego_or_by_two(said, contradicted):
    assert claim(*said).contradicted().tolist() == [contradicted]


@pytest.mark.parametrize(
    ("other", "sees", "hidden"),
    [
        ((5.0, 2.0, 4.5, 1.9, 0.0), YES, True),
        ((5.0, 2.0, 4.5, 1.9, 0.0), 0.0, False),  # the ego does not know it
        ((5.0, 2.0, 4.5, 1.9, 0.0), NO, False),
        ((5.0, 2.0, 1.9, 4.5, np.pi / 2), YES, True),
        ((5.0, 3.6, 4.5, 1.9, 0.0), YES, True),  # beside the line of sight, but near
        ((5.0, 4.6, 4.5, 1.9, 0.0), YES, False),
        ((5.0, 4.6, 4.5, 1.9, 1.2), YES, True),  # it lies across
        ((0.0, 6.0, 4.5, 1.9, 0.0), YES, False),
        ((15.0, 6.0, 4.5, 1.9, 0.0), YES, False),  # behind it
        ((-5.0, -2.0, 4.5, 1.9, 0.0), YES, False),
        ((9.5, 3.8, 4.5, 1.9, 0.0), YES, False),  # around it
    ],
)
@pytest.mark.parametrize("turned", [0.0, np.arctan2(PLACE[1], PLACE[0]), 2.0])
def test_what_is_behind_a_vehicle_that_the_ego_sees_it_does_not_know(other, sees, hidden, turned):
    cos, sin = np.cos(turned), np.sin(turned)
    boxes = np.array([*BOX, [*other, 0.9]])
    boxes[:, :2], boxes[:, 4] = boxes[:, :2] @ [[cos, -sin], [sin, cos]], boxes[:, 4] - turned
    said = np.array([[NO, sees], [YES, 0.0], [YES, 0.0]])
    assert Claims(boxes, ("", "a", "b"), said).contradicted().tolist() == [not hidden, sees == NO]
    alone = Claims(boxes, ("", "a", "b"), said * [[1], [1], [0]])
    assert alone.contradicted()[0]  # by the ego's word against one


def test_a_suspects_own_word_is_left_out_whatever_it_is():
    liar_denies = claim(-1.5, NO, NO, 0.0)
    assert liar_denies.contradicted().tolist() == [True]
    assert liar_denies.contradicted_by_others(["a"]).tolist() == [False]  # only "b" is left to deny it
    assert liar_denies.contradicted_by_others(["c"]).tolist() == [True]
    vouches = claim(0.0, NO, NO, YES, YES, YES)
    assert vouches.contradicted().tolist() == [False]
    assert vouches.contradicted_by_others(["c"]).tolist() == [False]  # "d" and "e" have still vouched for it
    assert vouches.without(["c", "d"]).contradicted().tolist() == [True]


@pytest.mark.parametrize(
    ("said", "to_blame"),
    [
        ((-3.2, -6.0, YES), False),  # one who denies it and the ego, a little: the one may lie
        ((-3.2, -6.0, 0.0, 0.0, YES), False),
        ((-4.5, -6.0, YES), True),
        ((-3.2, -6.0, -1.0, YES), True),
        ((-2.0, -5.0, -5.0, YES), True),
        ((0.0, -6.0, -6.0, YES), False),  # the other two may lie together
        ((0.0, -6.0, -6.0, 0.0, YES), False),
        ((0.0, -6.0, -6.0, -6.0, YES), True),
        ((-5.2, -3.5, YES), True),  # the ego does not lie
        ((-7.0, YES), True),  # the ego knows
        ((-6.5, YES), False),  # not quite
        ((-3.5, -3.5, YES), False),  # too little in all
    ],
)
def test_nobody_is_to_blame_for_a_box_by_the_word_of_one(said, to_blame):
    assert claim(*said).contradicted_by_others(["abcde"[len(said) - 2]]).tolist() == [to_blame]


def test_without_some_their_word_counts_for_nothing():
    claims = claim(0.0, NO, NO, YES)
    rest = claims.without(["a", "c"])
    assert rest.witnesses == ("", "b")
    assert rest.denying.tolist() == [[False], [True]]
    assert rest.supporting.tolist() == [[False], [False]]
    assert rest.contradicted().tolist() == [False]


@pytest.mark.parametrize(
    ("value", "supports", "denies"), [(SUPPORTS + 0.1, 1, 0), (2.9, 0, 0), (-2.9, 0, 0), (DENIES - 0.1, 0, 1)]
)
def test_who_speaks_for_and_against(value, supports, denies):
    claims = claim(0.0, value)
    assert (claims.supporting.sum(), claims.denying.sum()) == (supports, denies)


def test_a_place_a_little_off_is_no_denial():
    """Of what is said around a centre, along and across the box, the best counts."""
    off = PLACE + (SPREAD_M + 0.9 * AROUND_M) * np.array([np.cos(0.3), np.sin(0.3)])
    heard = saying({"": [(*PLACE, NO), (*off, YES)], "a": [(*PLACE, NO)]})
    claims = Claims.of(BOX, heard)
    assert claims.likelihood[0, 0] > heard.likelihood(BOX[:, :2])[0, 0] + 1
    assert claims.likelihood[1, 0] == pytest.approx(-MOST)


@pytest.mark.parametrize(("aside", "found"), [(3.0, False), (-3.0, True), (5.0, True), (None, True)])
def test_what_is_seen_toward_a_box_beside_speaks_for_that_one(aside, found):
    """A witness speaks of what is just to the left of a box. Another box is there, or to the right, or far."""
    ahead, left = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    heard = saying({"": [], "a": [(*(PLACE + (SPREAD_M + 0.9 * AROUND_M) * left), YES)]})
    others = BOX if aside is None else np.vstack([BOX, BOX + [*(aside * left + 0.1 * ahead), 0, 0, 0, 0]])
    alone, beside = (Claims.of(BOX, heard, shown).likelihood[1, 0] for shown in (None, others))
    assert alone >= SUPPORTS
    assert beside == pytest.approx(alone) if found else beside < SUPPORTS - 1


def test_claims_are_looked_up_where_each_witness_stands():
    poses = {"a": pose_matrix(20.0, 4.0, 1.6, np.pi)}
    claims = Claims.of(BOX, saying({"": [], "a": [(*PLACE, YES)]}, poses))
    assert claims.likelihood[:, 0] == pytest.approx([0.0, YES], abs=0.1)


def test_no_boxes_make_no_claims():
    claims = Claims.of(BOX[:0], saying({"": [], "a": []}))
    assert claims.contradicted().shape == (0,)
    assert claims.likelihood.shape == (2, 0)


def test_the_ego_or_two_teammates_are_two_witnesses():
    speaking = np.array([[1, 0, 0, 0], [0, 1, 1, 0], [0, 0, 1, 0]], dtype=bool)
    assert two_witnesses(speaking).tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("said", "rest"),
    [
        ((-2.0, YES, YES), -2.0),
        ((-2.0, YES, YES, YES), 4.0),  # two may lie together, a third is believed
        ((-2.0, YES, 2.0), 0.0),
        ((-0.5, -0.6, YES), -1.1),
        ((0.0, YES, YES, -5.0), -5.0),
        ((4.0, YES, -1.0), 3.0),
        ((0.0, 0.0, 0.0), 0.0),
    ],
)
def test_what_the_rest_say_is_without_those_who_vouch(said, rest):
    assert claim(*said).rest.tolist() == [pytest.approx(rest, abs=0.1)]


@pytest.mark.parametrize(
    ("said", "conflicting"),
    [
        ((0.0, NO, NO, NO, YES), ["d"]),
        ((NO, NO, 0.0, 0.0, YES), ["d"]),
        ((0.0, NO, NO, 0.0, YES), []),  # two may lie together
        ((0.0, YES, YES, 0.0, NO), []),
        ((YES, YES, 0.0, 0.0, NO), ["d"]),
        ((0.0, NO, NO, NO, 4.0), []),  # not so sure of it
    ],
)
def test_who_is_in_conflict_with_all_others(said, conflicting):
    claims = claim(*said)
    supported, denied = claims.in_conflict(())
    against = supported if YES in said[4:] or 4.0 in said[4:] else denied
    assert [name for name, one in zip(claims.witnesses, against.any(axis=1), strict=True) if one] == conflicting
    assert (supported | denied).sum() == len(conflicting)


def test_what_nobody_hears_is_no_conflict():
    claims = claim(0.0, NO, NO, NO, YES)
    assert not np.any(claims.in_conflict(["a"]))
