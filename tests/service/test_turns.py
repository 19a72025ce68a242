"""Who gets the one thread next."""

import math
from collections import Counter

import pytest

from service.turns import CREDIT_S, KNOWN, SLACK_S, Turns, Work

PASS_S = 0.007


def work_of(key, session_id, due=math.inf, expected_s=0.0):
    return Work(key, session_id, due, expected_s)


def played(turns, number):
    """Work in the order of its turns, each as long as a pass."""
    order = []
    for _ in range(number):
        work = turns.next(0.0)
        turns.charge(work, PASS_S)
        order.append(work)
    return order


def waiting(*works):
    turns = Turns()
    for work in works:
        turns.add(work)
    return turns


def test_a_key_with_ten_sessions_gets_no_more_than_a_key_with_one():
    turns = waiting(work_of("one", "a"), *(work_of("ten", f"s{i}") for i in range(10)))
    had = Counter(work.key for work in played(turns, 1000))
    assert abs(had["one"] - had["ten"]) * PASS_S <= SLACK_S + PASS_S


def test_the_sessions_of_a_key_share_its_time():
    turns = waiting(*(work_of("", f"s{i}", due=i) for i in range(4)))
    had = Counter(work.session_id for work in played(turns, 400))
    assert max(had.values()) - min(had.values()) <= SLACK_S / PASS_S + 1


def test_among_equals_what_is_due_first_goes_first():
    turns = waiting(work_of("", "late", 9.0), work_of("", "soon", 1.0), work_of("", "middle", 5.0))
    order = []
    while len(turns):
        work = turns.next(0.0)
        order.append(work.session_id)
        turns.charge(work, 0.001)
        turns.remove(work)
    assert order == ["soon", "middle", "late"]


def test_a_short_frame_does_not_wait_for_a_long_one():
    turns = waiting(work_of("", "long", 60.0))
    played(turns, 500)
    short = work_of("", "short", 0.2)
    turns.add(short)
    assert played(turns, 2) == [short, short]


def test_who_is_due_first_does_not_get_more_than_a_fair_share():
    turns = waiting(work_of("", "hurried", 1.0), work_of("", "patient", 60.0))
    had = Counter(work.session_id for work in played(turns, 400))
    assert abs(had["hurried"] - had["patient"]) <= SLACK_S / PASS_S + 1


def test_time_that_was_not_wanted_is_not_saved_up():
    idle, busy = work_of("idle", "a"), work_of("busy", "b")
    turns = waiting(idle, busy)
    played(turns, 10)
    turns.remove(idle)
    played(turns, 500)
    turns.add(idle)
    had = Counter(work.key for work in played(turns, 200))
    assert abs(had["idle"] - had["busy"]) <= (CREDIT_S + SLACK_S) / PASS_S + 1


def test_who_goes_and_comes_back_has_had_what_it_had():
    greedy, modest = work_of("greedy", "a"), work_of("modest", "b", due=9.0)
    turns, had = waiting(greedy, modest), Counter()
    for _ in range(200):
        work = turns.next(0.0)
        turns.charge(work, PASS_S)
        had[work.key] += 1
        turns.remove(work)  # its frame is done, and the next one comes at once
        turns.add(work)
    assert abs(had["greedy"] - had["modest"]) <= SLACK_S / PASS_S + 1


def test_who_wants_little_goes_first_though_others_come_and_go():
    """Each frame of the greedy is over, and its next one not there yet, when the modest's comes."""
    turns, greedy, modest = Turns(), work_of("greedy", "a", due=1.0), work_of("modest", "b", due=9.0)
    turns.add(modest)
    turns.charge(turns.next(0.0), PASS_S)
    turns.remove(modest)
    for _ in range(5):
        turns.add(greedy)
        for _ in range(20):
            turns.charge(greedy, PASS_S)
        turns.remove(greedy)
        turns.add(modest)
        turns.add(greedy)
        assert played(turns, 10) == [modest] * 10
        turns.remove(modest)
        turns.remove(greedy)


def test_who_leads_goes_first_by_as_much():
    turns, greedy, modest = Turns(), work_of("greedy", "a"), work_of("modest", "b")
    for work, number in ((modest, 1), (greedy, 8)):
        turns.add(work)
        for _ in range(number):
            turns.charge(work, PASS_S)
        turns.remove(work)
    lead_s = turns.lead(modest, greedy)
    assert lead_s == -turns.lead(greedy, modest) == pytest.approx(8 * PASS_S)
    assert turns.order([greedy, modest]) == [modest, greedy]
    turns.add(modest)
    turns.add(greedy)
    first = [work.key for work in played(turns, 30)].index("greedy")
    assert abs(first * PASS_S - lead_s) <= SLACK_S + PASS_S
    assert turns.lead(work_of("nobody", "b"), work_of("nobody", "new")) == 0.0


def test_who_is_refused_for_the_sake_of_others_soon_goes_before_them():
    greedy, new, sibling = work_of("greedy", "a"), work_of("new", "b"), work_of("greedy", "c")
    turns = waiting(greedy)
    turns.order([greedy, new, sibling])
    assert turns.lead(new, greedy) == turns.lead(sibling, greedy) == 0.0
    played(turns, 10)
    assert turns.lead(new, greedy) == turns.lead(sibling, greedy) == pytest.approx(0.07)
    played(turns, 100)
    assert turns.lead(new, greedy) == pytest.approx(CREDIT_S)


def test_work_that_was_begun_is_not_put_off_for_that_of_equals():
    turns = waiting(*(work_of("", f"s{number}", 1.0 - number / 100, expected_s=0.3) for number in range(5)))
    order = []
    while len(turns):
        order.append(work := turns.next(0.0))
        turns.charge(work, 0.06)
        if work.had_s > 0.29:
            turns.remove(work)
    assert [order[i : i + 5] for i in range(0, 25, 5)] == [[order[i]] * 5 for i in range(0, 25, 5)]


def test_short_work_goes_before_long_work_that_was_begun():
    turns = waiting(long := work_of("", "long", 60.0, expected_s=4.0))
    assert played(turns, 5) == [long] * 5
    turns.add(short := work_of("", "short", 0.2, expected_s=0.02))
    assert played(turns, 3) == [short] * 3


def test_work_that_was_begun_and_is_about_to_be_due_goes_first():
    ends, goes_on = work_of("much", "a", due=1.0), work_of("little", "b", due=2.0)
    turns = waiting(ends, goes_on)
    turns.charge(ends, PASS_S)
    for _ in range(20):
        turns.charge(ends, PASS_S)
    assert turns.next(1.0 - 4 * PASS_S) is goes_on
    assert turns.next(1.0 - 2 * PASS_S) is turns.next(1.0 + 2 * PASS_S) is ends
    assert turns.next(1.1) is goes_on


def test_of_those_who_left_only_so_many_are_remembered():
    turns = Turns()
    for number in range(KNOWN + 100):
        for work in (work_of(f"key {number}", "its session"), work_of("", f"session {number}")):
            turns.add(work)
            turns.charge(work, PASS_S)
            turns.remove(work)
    assert len(turns._keys._had_s) == len(turns._sessions) == len(turns._sessions[""]._had_s) == KNOWN
    oldest = next(iter(turns._sessions))
    asked = [work_of("fresh", "s"), work_of(oldest, "s")]
    assert set(turns.order(asked)) == set(asked)
    with pytest.raises(IndexError):
        turns.next(0.0)


def test_work_that_is_done_elsewhere_counts_in_the_shares():
    here, other = work_of("reads", "a"), work_of("other", "b")
    turns = waiting(here, other)
    elsewhere = work_of("reads", "c")
    turns.join(elsewhere)
    turns.put_down(elsewhere, 0.5)
    turns.leave(elsewhere)
    first = Counter(work.key for work in played(turns, int((0.5 - 2 * SLACK_S) / PASS_S)))
    assert first["other"] == first.total()
    assert abs(Counter(work.key for work in played(turns, 200))["reads"] - 100) < 10


def test_of_work_elsewhere_that_of_a_key_goes_first_that_had_least_whatever_its_session_had():
    turns, works = Turns(), [work_of("a", "1"), work_of("b", "2"), work_of("b", "3")]
    for work in works:
        turns.join(work)
    for work, seconds in zip(works, [0.03, 0.01, 0.015], strict=True):
        turns.put_down(work, seconds)
    assert turns.first(works) is works[1]
    turns.put_down(works[1], 0.002)
    assert turns.first(works) is works[1]
    turns.put_down(works[2], 0.01)
    assert turns.first(works) is works[0]


def test_work_here_puts_off_that_elsewhere_which_had_more_until_it_will_have_had_as_much():
    frame, body = work_of("quiet", "f", expected_s=0.05), work_of("greedy", "b")
    turns = waiting(frame)
    turns.join(body)
    assert not turns.puts_off(body)
    turns.put_down(body, 0.04)
    assert not turns.puts_off(body)
    turns.put_down(body, 0.02)
    assert turns.puts_off(body)
    turns.remove(frame)
    assert not turns.puts_off(body)


def test_within_a_key_the_shares_of_sessions_put_off():
    frame, body = work_of("", "quiet", expected_s=0.05), work_of("", "greedy")
    turns = waiting(frame)
    turns.join(body)
    turns.put_down(body, 0.06)
    assert turns.puts_off(body)
    assert not turns.puts_off(work_of("", "quiet"))


def test_what_is_put_down_to_those_who_are_forgotten_does_no_harm():
    turns, gone = Turns(), work_of("gone", "s")
    turns.join(gone)
    turns.leave(gone)
    for number in range(2 * KNOWN + 2):
        other = work_of(f"k{number}", "s")
        turns.join(other)
        turns.leave(other)
    turns.put_down(gone, 0.1)
    turns.join(gone)
    assert turns.first([gone]) is gone
