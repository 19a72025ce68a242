"""Who gets the one thread next."""

import math
from collections import Counter
from dataclasses import dataclass

import pytest

from service.turns import CREDIT_S, SLACK_S, Turns

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


def test_those_who_left_are_forgotten():
    turns = Turns()
    for number in range(1000):
        work = Work(f"key {number}", f"session {number}")
        turns.add(work)
        turns.charge(work, PASS_S)
        turns.remove(work)
    assert (turns._keys.had_s, turns._sessions) == ({}, {})
    with pytest.raises(IndexError):
        turns.next()
