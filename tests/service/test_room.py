"""Whoever is greedy leaves room to the others: of its session, of its key, and of all keys."""

import pytest

from service.errors import Refused
from service.sessions.room import Room

BODY = 192 * 1024
FRAME = 12 * 2**20
LIMIT = 512 * 2**20


def taken(room, *who, nbytes=BODY, most=10_000):
    """How many such bodies are taken, announced one after another and never sent."""
    for count in range(most):
        if not fits(room, nbytes, *who):
            return count
        room.share(*who).add(nbytes)
    return most


def fits(room, nbytes, *who):
    try:
        room.share(*who).check(nbytes)
    except Refused:
        return False
    return True


@pytest.mark.parametrize("of_key", [None, LIMIT // 2, LIMIT])
def test_a_greedy_teammate_leaves_room_to_its_ego_its_key_and_other_keys(of_key):
    room = Room(LIMIT, of_key)
    assert taken(room, "a", "x", "car-2") > 300
    for who in (("a", "x", "ego"), ("a", "x", "car-3"), ("a", "y", "ego"), ("b", "z", "ego")):
        assert fits(room, 3 * FRAME, *who), who


def test_nor_do_two_of_them_that_come_from_two_keys():
    room = Room(LIMIT, LIMIT // 2)
    for _ in range(3):
        taken(room, "a", "x", "car-2")
        taken(room, "b", "y", "car-2")
    for who in (("a", "x", "ego"), ("a", "other", "ego"), ("b", "y", "ego"), ("b", "other", "ego")):
        assert fits(room, 3 * FRAME, *who), who


def test_a_session_whose_teammates_are_all_greedy_leaves_room_to_others_of_its_key():
    room = Room(LIMIT, LIMIT // 2)
    for name in range(63):
        taken(room, "a", "x", f"car-{name}")
    assert fits(room, 3 * FRAME, "a", "x", "ego")
    assert fits(room, LIMIT // 8, "a", "y", "ego")
    assert fits(room, LIMIT // 4, "b", "z", "ego")


@pytest.mark.parametrize("of_key", [None, LIMIT // 2])
def test_in_a_small_room_one_body_keeps_no_frame_out(of_key):
    room = Room(3 * FRAME, of_key)
    taken(room, "a", "x", "car-2")
    assert fits(room, FRAME, "a", "x", "ego")


def test_the_keys_of_several_hold_no_more_than_is_left_for_others_whatever_they_are_granted():
    room = Room(LIMIT, LIMIT)
    for session in range(100):
        taken(room, "a", str(session), "ego", nbytes=FRAME)
    assert 0.4 * LIMIT < room.nbytes <= LIMIT // 2
    assert fits(room, LIMIT // 2, "b", "z", "ego")


def test_one_key_has_all_to_itself():
    room = Room(8 * BODY)
    assert [taken(room, "", str(session), "rsu", most=1) for session in range(9)] == [1] * 8 + [0]


def test_whoever_holds_nothing_else_may_take_as_much_as_is_left():
    """A frame that came compressed holds its body already when it is known how much it expands to."""
    room = Room(LIMIT, LIMIT)
    share = room.share("a", "x", "ego")
    with share.holding(FRAME):
        with share.holding(LIMIT - FRAME):
            assert room.nbytes == LIMIT
        with room.share("a", "x", "ego").holding(BODY), pytest.raises(Refused, match="no more than is left"):
            share.check(LIMIT // 2)
    assert room.nbytes == 0


def test_it_is_said_who_allows_how_much():
    room = Room(LIMIT, 2 * BODY, "ROBOSAC_MAX_INFLIGHT_BYTES")
    with pytest.raises(Refused, match=f"ROBOSAC_MAX_INFLIGHT_BYTES_PER_KEY allows {2 * BODY} bytes of one key"):
        room.share("a", "x", "ego").check(3 * BODY)
    with pytest.raises(Refused, match=f"ROBOSAC_MAX_INFLIGHT_BYTES allows {LIMIT} bytes"):
        Room(LIMIT, None, "ROBOSAC_MAX_INFLIGHT_BYTES").share("a", "x", "ego").check(LIMIT + 1)
