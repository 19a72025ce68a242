import pytest

from robosac.deadline import SAFETY, Deadline, Recorded


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_by_default_there_is_time_for_everything():
    deadline = Deadline()
    assert deadline.another_fits()
    assert deadline.is_met


def test_a_pass_fits_as_long_as_the_dearest_so_far_would():
    clock = Clock()
    deadline = Deadline(10.0, reserve_s=1.0, clock=clock)
    for cost in (2.0, 1.0):
        with deadline.a_pass():
            clock.now += cost
    clock.now = 9.0 - SAFETY * 2.0
    assert deadline.another_fits()
    clock.now += 0.01
    assert not deadline.another_fits()
    assert deadline.is_met


def test_what_is_reserved_is_no_time_for_an_answer():
    clock = Clock()
    deadline = Deadline(10.0, reserve_s=1.0, clock=clock)
    clock.now = 9.0
    assert deadline.is_met
    clock.now = 9.1
    assert not deadline.is_met


def test_a_pass_that_fails_teaches_nothing():
    clock = Clock()
    deadline = Deadline(10.0, clock=clock)

    def fail():
        with deadline.a_pass():
            clock.now += 20.0
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    clock.now = 0.0
    assert deadline.another_fits()


def test_a_recorded_one_passes_after_as_many_hypotheses():
    deadline = Recorded(2)
    assert [deadline.another_fits() for _ in range(4)] == [True, True, False, False]


def test_reading_gets_a_share_of_the_time_that_is_left():
    clock = Clock()
    fits = Deadline(10.0, reserve_s=2.0, clock=clock).reading(0.5)
    assert fits(["a"])
    clock.now = 1.5
    assert fits(["b"])  # another 1.5 s would end in time
    clock.now = 3.0
    assert not fits(["c"])
    assert Deadline().reading(0.5)(["a"])


def test_a_pause_is_not_taken_for_what_reading_costs():
    clock = Clock()
    deadline = Deadline(10.0, clock=clock)
    fits = deadline.reading(0.9)
    assert fits(["a"])
    clock.now = 0.5
    with deadline.pause():
        clock.now = 7.0
    assert fits(["b"])
    clock.now = 8.5
    assert not fits(["c"])


def test_nothing_is_read_once_it_is_late():
    clock = Clock()
    clock.now = 11.0
    assert not Deadline(10.0, clock=clock).reading(0.5)(["a"])


def test_a_recorded_one_reads_what_was_read():
    fits = Recorded(None, ["c"]).reading(0.5)
    assert [fits(group) for group in (["a", "b"], ["c", "d"])] == [True, False]


def test_there_is_room_for_as_many_as_would_fit_one_after_the_other():
    clock = Clock()
    deadline = Deadline(10.0, clock=clock)
    assert deadline.room(7) == 7  # nothing is known of what a pass takes
    deadline.expect(1.0)
    assert [deadline.room(most) for most in (20, 7, 3)] == [int(10.0 / SAFETY) - 1, 7, 3]
    clock.now = 10.0 - SAFETY * 1.5
    assert deadline.room(7) == 0
    clock.now = 10.1
    assert deadline.room(7) == 0
    assert Deadline(0.0, clock=clock).room(7) == 0
    assert Deadline().room(7) == 7


def test_there_is_room_for_no_more_than_may_be_tested():
    deadline = Deadline(hypotheses=3)
    assert deadline.room(7) == 3
    assert deadline.another_fits()
    assert deadline.room(7) == 2


def test_what_takes_no_pass_fits_until_the_end():
    clock = Clock()
    deadline = Deadline(10.0, clock=clock, hypotheses=1)
    deadline.expect(5.0)
    clock.now = 9.0
    assert not deadline.another_fits()
    assert deadline.another_fits(takes_a_pass=False)
    assert not deadline.another_fits(takes_a_pass=False)  # it counts, too
