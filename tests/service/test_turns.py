"""Who gets the one thread next."""

import math
from collections import Counter
from dataclasses import dataclass

import pytest

from service.turns import CREDIT_S, KNOWN, SLACK_S, Turns

PASS_S = 0.007


@dataclass(eq=False)
class Work:
    key: str
    session_id: str
    due: float = math.inf


def played(turns, number):
    """Work in the order of its turns, each as long as a pass."""
    order = []
    for _ in range(number):
        work = turns.next()
        turns.charge(work, PASS_S)
        order.append(work)
    return order


def waiting(*works):
    turns = Turns()
    for work in works:
        turns.add(work)
    return turns


def test_a_key_with_ten_sessions_gets_no_more_than_a_key_with_one():
    turns = waiting(Work("one", "a"), *(Work("ten", f"s{i}") for i in range(10)))
    had = Counter(work.key for work in played(turns, 1000))
    assert abs(had["one"] - had["ten"]) * PASS_S <= SLACK_S + PASS_S


def test_the_sessions_of_a_key_share_its_time():
    turns = waiting(*(Work("", f"s{i}", due=i) for i in range(4)))
    had = Counter(work.session_id for work in played(turns, 400))
    assert max(had.values()) - min(had.values()) <= SLACK_S / PASS_S + 1


def test_among_equals_what_is_due_first_goes_first():
    turns = waiting(Work("", "late", 9.0), Work("", "soon", 1.0), Work("", "middle", 5.0))
    order = []
    while len(turns):
        work = turns.next()
        order.append(work.session_id)
        turns.charge(work, 0.001)
        turns.remove(work)
    assert order == ["soon", "middle", "late"]


def test_a_short_frame_does_not_wait_for_a_long_one():
    turns = waiting(Work("", "long", 60.0))
    played(turns, 500)
    short = Work("", "short", 0.2)
    turns.add(short)
    assert played(turns, 2) == [short, short]


def test_who_is_due_first_does_not_get_more_than_a_fair_share():
    turns = waiting(Work("", "hurried", 0.0), Work("", "patient", 60.0))
    had = Counter(work.session_id for work in played(turns, 400))
    assert abs(had["hurried"] - had["patient"]) <= SLACK_S / PASS_S + 1


def test_time_that_was_not_wanted_is_not_saved_up():
    idle, busy = Work("idle", "a"), Work("busy", "b")
    turns = waiting(idle, busy)
    played(turns, 10)
    turns.remove(idle)
    played(turns, 500)
    turns.add(idle)
    had = Counter(work.key for work in played(turns, 200))
    assert abs(had["idle"] - had["busy"]) <= (CREDIT_S + SLACK_S) / PASS_S + 1


def test_who_goes_and_comes_back_has_had_what_it_had():
    greedy, modest = Work("greedy", "a"), Work("modest", "b", due=9.0)
    turns, had = waiting(greedy, modest), Counter()
    for _ in range(200):
        work = turns.next()
        turns.charge(work, PASS_S)
        had[work.key] += 1
        turns.remove(work)  # its frame is done, and the next one comes at once
        turns.add(work)
    assert abs(had["greedy"] - had["modest"]) <= SLACK_S / PASS_S + 1


def test_who_wants_little_goes_first_though_others_come_and_go():
    """Each frame of the greedy is over, and its next one not there yet, when the modest's comes."""
    turns, greedy, modest = Turns(), Work("greedy", "a", due=0.0), Work("modest", "b", due=9.0)
    turns.add(modest)
    turns.charge(turns.next(), PASS_S)
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
    turns, greedy, modest = Turns(), Work("greedy", "a"), Work("modest", "b")
    for work, number in ((modest, 1), (greedy, 8)):
        turns.add(work)
        for _ in range(number):
            turns.charge(work, PASS_S)
        turns.remove(work)
    lead_s = turns.lead("modest", "b", "greedy", "a")
    assert lead_s == -turns.lead("greedy", "a", "modest", "b") == pytest.approx(8 * PASS_S)
    turns.add(modest)
    turns.add(greedy)
    first = [work.key for work in played(turns, 30)].index("greedy")
    assert abs(first * PASS_S - lead_s) <= SLACK_S + PASS_S
    assert turns.lead("modest", "b", "modest", "new") == 0.0
    assert turns.lead("nobody", "b", "nobody", "new") == 0.0


def test_who_is_refused_for_the_sake_of_others_soon_goes_before_them():
    turns = waiting(Work("greedy", "a"))
    assert turns.lead("new", "b", "greedy", "a") == turns.lead("greedy", "c", "greedy", "a") == 0.0
    played(turns, 10)
    assert turns.lead("new", "b", "greedy", "a") == turns.lead("greedy", "c", "greedy", "a") == pytest.approx(0.07)
    played(turns, 100)
    assert turns.lead("new", "b", "greedy", "a") == pytest.approx(CREDIT_S)


def test_of_those_who_left_only_so_many_are_remembered():
    turns = Turns()
    for number in range(KNOWN + 100):
        for work in (Work(f"key {number}", "its session"), Work("", f"session {number}")):
            turns.add(work)
            turns.charge(work, PASS_S)
            turns.remove(work)
    assert len(turns._keys._had_s) == len(turns._sessions) == len(turns._sessions[""]._had_s) == KNOWN
    with pytest.raises(IndexError):
        turns.next()
