from types import SimpleNamespace

import numpy as np
import pytest

from robosac.attacks import Lie
from robosac.evaluation.objects import Judged, ObjectHistory, Shown, judge, object_rates

TRUTH = np.array([[0.0, 0.0, 4.5, 1.9, 0.0], [10.0, 0.0, 4.5, 1.9, 0.0]])
GHOST = Lie("ghost", np.array([20.0, 0.0, 4.5, 1.9, 0.0]))
ERASED = Lie("erased", TRUTH[1])
MOVED = Lie("moved", TRUTH[1] + [0, 1.2, 0, 0, 0], truth=TRUTH[1])
TURNED = TRUTH[1] + [0, 0, 0, 0, np.pi / 4]


def boxes(*rows):
    return np.array([[x, y, 4.5, 1.9, 0.0, score] for x, y, score in rows]).reshape(-1, 6)


IDEAL = boxes((0, 0, 0.9), (10, 0, 0.9))


def holds(lie, *rows, ideal=IDEAL, truth=TRUTH):
    (judged,) = judge([lie], Shown(boxes(*rows)), truth, ideal)
    assert (judged.flagged, judged.told_as) == (None, None)
    return judged.holds


def test_a_ghost_holds_where_a_box_stands_for_no_vehicle():
    assert holds(GHOST, (0, 0, 0.9), (20.5, 1.0, 0.3))
    assert not holds(GHOST, (20.5, 1.0, 0.29))
    assert not holds(GHOST, (22.1, 0.0, 0.9))
    passing = np.vstack([TRUTH, [[20.5, 0.5, 4.5, 1.9, 0.0]]])
    assert not holds(GHOST, (20.5, 0.6, 0.9), truth=passing)  # the box of a vehicle that drives through it
    assert holds(GHOST, (20.5, 0.6, 0.9), (19.5, -0.9, 0.8), truth=passing)
    assert holds(GHOST, (20.0, 0.0, 0.9), truth=np.empty((0, 5)))
    assert not holds(GHOST)


def test_an_erased_vehicle_is_missing_where_the_oracle_finds_it():
    assert holds(ERASED, (0, 0, 0.9))
    assert holds(ERASED, (0, 0, 0.9), (10.0, 1.5, 0.9))
    assert not holds(ERASED, (10.3, 0.2, 0.3))
    assert holds(ERASED, (10.3, 0.2, 0.29))
    assert judge([ERASED], Shown(boxes()), TRUTH, boxes((10.3, 0.2, 0.29))) == ()
    assert judge([ERASED], Shown(boxes()), TRUTH, boxes((0, 0, 0.9))) == ()


def test_a_vehicle_is_moved_where_its_box_is_nearer_to_the_lie():
    assert holds(MOVED, (10.0, 0.7, 0.9))
    assert not holds(MOVED, (10.0, 0.5, 0.9))
    assert not holds(MOVED, (10.0, 0.7, 0.2))
    assert not holds(MOVED, (0.0, 0.0, 0.9))
    assert not holds(MOVED, (10.0, 1.9, 0.9), (10.0, 0.1, 0.5))  # the nearest one counts


@pytest.mark.parametrize(
    "lie", [Lie("reshaped", TRUTH[1] * [1, 1, 2, 2, 1], truth=TRUTH[1]), Lie("reshaped", TURNED, truth=TRUTH[1])]
)
def test_a_vehicle_is_reshaped_where_its_box_is_more_like_the_lie(lie):
    def seen(box, score=0.9, other=()):
        (judged,) = judge([lie], Shown(np.array([[*box, score], *other]).reshape(-1, 6)), TRUTH, IDEAL)
        return judged.holds

    assert seen(lie.box)
    assert not seen(TRUTH[1])
    assert not seen(lie.box, score=0.29)
    assert not seen(TRUTH[0])
    assert not seen(lie.box + [0.3, 0.3, 0, 0, 0.05], other=[[*TRUTH[1], 0.4]])  # the most alike counts
    (none,) = judge([lie], Shown(boxes()), TRUTH, IDEAL)
    assert none == Judged(0, False)
    (repaired,) = judge([lie], Shown.of(answer(np.array([[*TRUTH[1], 0.9]]), ["repaired"])), TRUTH, IDEAL)
    assert repaired == Judged(0, False, True, "")
    (told,) = judge([lie], Shown.of(answer(np.array([[*lie.box, 0.9]]), ["confirmed"])), TRUTH, IDEAL)
    assert told == Judged(0, True, False, "confirmed")


def answer(shown, standing, contradicted=()):
    """An answer as a defence gives it that knows how its boxes stand."""
    support = [SimpleNamespace(status=status) for status in standing]
    return SimpleNamespace(boxes=shown, support=support, contradicted=[SimpleNamespace(box=b) for b in contradicted])


def test_what_is_contradicted_is_flagged_and_not_told():
    told = boxes((0, 0, 0.9), (20, 0, 0.8))
    (confirmed,) = judge([GHOST], Shown.of(answer(told, ["confirmed", "confirmed"])), TRUTH, IDEAL)
    assert confirmed == Judged(0, True, False, "confirmed")
    (single,) = judge([GHOST], Shown.of(answer(told, ["confirmed", "single_witness"])), TRUTH, IDEAL)
    assert single == Judged(0, True, False, "single_witness")
    twice = Shown.of(answer(boxes((20, 0, 0.8), (20, 1, 0.4)), ["disputed", "single_witness"]))
    assert judge([GHOST], twice, TRUTH, IDEAL) == (single,)  # the surest counts
    left_out = Shown.of(answer(told[:1], ["confirmed"], [tuple(told[1])]))
    kept_in = Shown.of(answer(told, ["confirmed", "contradicted"]))
    for shown in (left_out, kept_in):
        assert judge([GHOST], shown, TRUTH, IDEAL) == (Judged(0, False, True, ""),)
        assert len(shown.boxes) == 1


def test_what_is_repaired_is_flagged():
    repaired = Shown.of(answer(boxes((10, 0, 0.8)), ["repaired"]))
    assert judge([ERASED], repaired, TRUTH, IDEAL) == (Judged(0, False, True),)
    assert judge([MOVED], repaired, TRUTH, IDEAL) == (Judged(0, False, True, ""),)
    there = Shown.of(answer(boxes((10, 0, 0.8)), ["confirmed"]))
    assert judge([ERASED], there, TRUTH, IDEAL) == (Judged(0, False, False),)


def history(*held, undefended=None, named=()):
    """Of one lie, by frame: whether it holds; None where it is not judged."""

    def frames(values):
        return [() if value is None else (Judged(0, bool(value)),) for value in values]

    return ObjectHistory(frames(held), frames(held if undefended is None else undefended), list(named))


def test_runs_are_of_one_and_the_same_lie():
    assert history(1, 1, 0, 1, 1, 1, None, 1).longest == 3
    assert history(0).longest == 0
    two = ObjectHistory([(Judged(0, True), Judged(1, False)), (Judged(0, False), Judged(1, True)), (Judged(1, True),)])
    assert two.longest == 2


def test_naming_counts_from_the_first_frame_in_which_the_lie_shows():
    late = history(0, 0, 0, undefended=(0, 1, 1), named=(False, False, True))
    assert (late.first_shown, late.frames_to_name) == (1, 2)
    assert history(0, 0, undefended=(0, 0), named=(False, True)).frames_to_name is None
    assert history(1, 1, named=(False, False)).frames_to_name is None
    assert history(0, 1, undefended=(0, 1), named=(True, True)).frames_to_name == 1  # named before it ever showed


def test_frames_until_flagged_are_of_each_lie():
    judged = [(Judged(0, True, False),), (Judged(0, False, True), Judged(1, True, False)), (Judged(1, False, True),)]
    assert ObjectHistory(judged).frames_to_flag == [2, 2]


def test_how_a_lie_is_told_is_counted_apart():
    told = [(Judged(0, bool(status), False, status),) for status in ("confirmed", "disputed", "disputed", "")]
    erased = [(Judged(1, True, False),)] * 3
    rates = object_rates([ObjectHistory(told + erased, told + erased, [])])
    assert [rates[name] for name in ("confirmed", "single_witness", "disputed")] == [1 / 4, 0.0, 2 / 4]


def test_rates_are_over_object_frames_of_all_sequences():
    one = history(1, 0, None, 1, named=(False, False, False, True))
    two = history(0, 0, undefended=(0, 0), named=(False, False))
    assert object_rates([one, two]) == {
        "object_frames": 5,
        "held": pytest.approx(2 / 5),
        "longest": 1,
        "flagged": None,
        "confirmed": None,
        "single_witness": None,
        "disputed": None,
        "frames_to_flag": None,
        "sequences_shown": 1,
        "shown_named": 1,
        "frames_to_name": 4.0,
    }
    assert object_rates([ObjectHistory([(), ()]), ObjectHistory()]) is None
