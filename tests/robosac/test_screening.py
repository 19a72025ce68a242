"""Tests of messages before any is fused, by what vehicles send in successive frames."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Distrust, Reason
from robosac.boxes import pose_matrix
from robosac.defenses import EGO
from robosac.detectors import Message
from robosac.screening import Bounds, Screening, joined, separated
from robosac.screening.judging import MOST_TOLD
from robosac.screening.past import KEPT_FRAMES

KNOWN = Screening({"features": Bounds(largest=5.0, rms=1.2, still=0.99)})
SHAPE = (8, 16, 16)


@pytest.fixture
def draw(rng):
    return lambda scale=1.0: (rng.normal(size=SHAPE) * scale).astype(np.float16)


def at(x, features, name="features"):
    return Message(pose_matrix(x, 0.0, 1.9, 0.0), {name: features})


def noisy(features, share, rng):
    return (np.sqrt(1 - share**2) * features + share * rng.normal(size=SHAPE)).astype(np.float16)


class Frames:
    """Puts frame after frame to the tests; the ego sends a fresh map in each."""

    def __init__(self, draw, screening=KNOWN):
        self.draw, self.screening, self.memory, self.frame = draw, screening, {}, 0

    def __call__(self, ego=None, /, **teammates):
        ego = ego if isinstance(ego, Message) else at(0.0, self.draw() if ego is None else ego)
        screened = self.screening.screen(self.memory, self.frame, ego, teammates)
        self.memory = json.loads(json.dumps(screened.memory))
        self.frame += 1
        return screened


def why(screened):
    return {name: (refused.reason, dict(refused.evidence)) for name, refused in screened.refused.items()}


def test_honest_messages_pass(draw):
    play = Frames(draw)
    for frame in range(8):
        screened = play(a=at(2.0 * frame, draw()), b=at(9.0, draw()))
        assert (screened.refused, screened.alike) == ({}, ())


@pytest.mark.parametrize(("scale", "spike"), [(3.0, 0.0), (1.0, 14.0), (1.0, -14.0), (1.0, np.nan), (1.0, np.inf)])
def test_a_message_far_larger_than_honest_ones_is_implausible(scale, spike, draw):
    features = draw(scale)
    features[0, 0, 0] += np.float16(spike)
    screened = Frames(draw)(a=at(0.0, features), b=at(9.0, draw()))
    (reason, evidence) = why(screened)["a"]
    assert (reason, evidence["tensor"]) == (Reason.IMPLAUSIBLE, "features")
    assert (evidence["most_largest"], evidence["most_rms"]) == pytest.approx((10.0, 2.4))
    assert set(screened.refused) == {"a"}
    json.dumps(evidence, allow_nan=False)


def test_a_detector_of_which_nothing_is_known_has_no_bounds(draw):
    assert Frames(draw, Screening())(a=at(0.0, draw(100.0))).refused == {}
    other = Screening({"points": Bounds(1.0, 1.0, 0.9)})
    assert Frames(draw, other)(a=at(0.0, draw(100.0))).refused == {}


@pytest.mark.parametrize("screening", [KNOWN, Screening()])
def test_the_same_map_from_elsewhere_is_repeated(screening, draw):
    play, frozen = Frames(draw, screening), draw()
    found = [why(play(a=at(2.0 * frame, frozen), b=at(9.0, draw()))).get("a") for frame in range(9)]
    assert found[:2] == [None, None]
    assert [reason for reason, _ in found[2:]] == [Reason.REPEATED] * 7
    assert found[2][1] == {"of_frame": 0, "moved_m": 4.0, "correlation": 1.0}
    assert found[8][1]["moved_m"] == 16.0


@pytest.mark.parametrize(("every", "named_in"), [(100, [7, 8, 9, 10, 11]), (KEPT_FRAMES, []), (KEPT_FRAMES + 2, [])])
def test_who_has_nothing_new_for_a_moment_is_left_out_and_not_named(draw, every, named_in):
    play, maps = Frames(draw), [draw() for _ in range(12)]
    found = [play(a=at(4.0 * frame, maps[frame // every])).refused.get("a") for frame in range(12)]
    assert [frame for frame, why in enumerate(found) if why is not None] == [f for f in range(12) if f % every]
    assert [frame for frame, why in enumerate(found) if why and why.distrust is Distrust.NAMED] == named_in


def test_who_sends_a_near_repetition_is_named_whenever_it_sent_the_map_first(draw, rng):
    play, frozen = Frames(draw), draw()
    found = [play(a=at(4.0 * frame, noisy(frozen, 0.02, rng))).refused.get("a") for frame in range(9)]
    named = [frame for frame, why in enumerate(found) if why and why.distrust is Distrust.NAMED]
    assert named[0] == 3


@pytest.mark.parametrize(("every", "named"), [(100, [22, 23]), (8, []), (22, []), (23, [22])])
def test_at_twenty_frames_a_second_nothing_new_may_come_for_a_second_too(draw, every, named):
    play, maps = Frames(draw, replace(KNOWN, frame_period_s=0.05)), [draw() for _ in range(24)]
    found = [play(a=at(4.0 * frame, maps[frame // every])).refused.get("a") for frame in range(24)]
    assert [frame for frame, why in enumerate(found) if why and why.distrust is Distrust.NAMED] == named


def test_who_is_late_and_overheard_is_left_out_and_not_named(draw):
    play, maps = Frames(draw), [draw() for _ in range(9)]
    for frame in range(1, 9):
        refused = play(late=at(4.0 * frame, maps[frame - 1]), thief=at(4.0 * frame + 2, maps[frame])).refused
        if frame > 1:
            assert {name: (why.reason, why.distrust) for name, why in refused.items()} == {
                "late": (Reason.COPIED, None)
            }


def test_who_sends_what_the_ego_sent_is_named(draw):
    play, found = Frames(draw), []
    for frame in range(5):
        own = draw()
        found.append(play(own, a=at(4.0 * frame, own)).refused["a"])
    assert {why.reason for why in found} == {Reason.COPIED}
    assert [why.distrust is Distrust.NAMED for why in found] == [False, False, True, True, True]


def test_who_sends_what_the_ego_sent_again_and_again_has_no_grace(draw):
    play, own = Frames(draw), draw()
    found = [play(own if frame == 0 else None, a=at(4.0 * frame, own)).refused["a"] for frame in range(4)]
    assert {why.reason for why in found} == {Reason.COPIED}
    assert [why.distrust is Distrust.NAMED for why in found] == [False, False, True, True]


def test_who_sends_a_copy_again_and_again_is_named_for_repeating_it(draw):
    play, copied = Frames(draw), draw()
    play(a=at(0.0, draw()), b=at(9.0, copied))
    found = [play(a=at(4.0 * frame, copied), b=at(9.0, draw())).refused["a"] for frame in range(1, 10)]
    assert [why.reason for why in found] == [Reason.COPIED] + [Reason.REPEATED] * 8
    assert [frame for frame, why in enumerate(found, 1) if why.distrust is Distrust.NAMED] == [8, 9]


def test_a_slow_vehicle_that_repeats_itself_is_found_once_it_is_elsewhere(draw):
    play, frozen = Frames(draw, Screening()), draw()
    refused = [bool(play(a=at(0.4 * frame, frozen)).refused) for frame in range(12)]
    assert refused == [False] * 8 + [True] * 4


def test_a_parked_vehicle_never_fails_whatever_it_sends_again(draw):
    play, same = Frames(draw), draw()
    rng = np.random.default_rng(1)
    for _ in range(60):
        assert play(a=at(rng.normal(0.0, 0.4), same)).refused == {}


def test_a_constant_map_of_a_blind_sensor_is_no_repetition(draw):
    play, blind = Frames(draw), np.zeros(SHAPE, np.float16)
    for frame in range(8):
        screened = play(blind, a=at(5.0 * frame, blind), b=at(5.0 * frame, blind + np.float16(0.5)))
        assert (screened.refused, screened.alike) == ({}, ())


def test_what_was_sent_long_ago_is_forgotten(draw):
    play, old = Frames(draw), draw()
    play(a=at(0.0, old))
    for frame in range(1, KEPT_FRAMES + 1):
        play(a=at(5.0 * frame, draw()))
    assert play(a=at(50.0, old)).refused == {}
    assert len(play.memory["a"]["sent"]) <= KEPT_FRAMES
    for _ in range(KEPT_FRAMES):
        play(b=at(0.0, draw()))
    assert set(play.memory) == {EGO, "b"}


def test_what_was_sent_is_forgotten_though_frames_are_counted_anew(draw):
    """As by a counter of 8 bits, or where a clip is played again and again in one session."""
    play, most = Frames(draw), 0
    for number in range(60):
        play.frame = number % 12
        play(a=at(2.0 * number, draw()), **({"b": at(9.0, draw())} if number == 11 else {}))
        most = max(most, len(play.memory["a"]["sent"]))
    assert most <= KEPT_FRAMES
    assert "b" not in play.memory


def test_a_near_repetition_is_closer_than_two_scans_of_one_place(draw, rng):
    play, frozen = Frames(draw), draw()
    found = [why(play(a=at(4.0 * frame, noisy(frozen, 0.02, rng)))).get("a") for frame in range(9)]
    assert found[0] is None
    reasons = [each and each[0] for each in found[1:]]
    assert reasons.count(Reason.REPEATED) >= 6
    assert all(each[1]["correlation"] > 0.999 for each in found[1:] if each)


def test_a_near_repetition_is_found_in_frame_after_frame(draw, rng):
    """Not only in the first that is far enough: what it repeats is remembered for a while."""
    play, frozen = Frames(draw), draw()
    refused = [f for f in range(11) if play(a=at(2.0 * f, noisy(frozen, 0.02, rng))).refused]
    assert refused == [2, 3, 4, 5, 7, 8, 9, 10]


def test_a_near_repetition_is_only_told_where_honest_scans_are_as_close(draw, rng):
    """As of a vehicle on an empty road, which sees the same all along."""
    for screening in (KNOWN, Screening()):
        play, road = Frames(draw, screening), draw()
        for frame in range(12):
            screened = play(a=at(4.0 * frame, noisy(road, 0.1, rng)))
            assert screened.refused == {}
            told = [(each.vehicle, each.other, each.of_frame) for each in screened.alike]
            assert told == ([("a", "a", frame - 1)] if frame else [])


def test_in_a_tunnel_where_the_ego_repeats_itself_as_much_nobody_does(draw, rng):
    """With clean scanners all places look the same there; whoever sends one map again is closer than that."""
    play, walls, frozen, repeated = Frames(draw), draw(), draw(), 0
    for frame in range(24):  # the ego is somewhere else in every second frame only
        ego = at(2.0 * frame, noisy(walls, 0.02, rng))
        sent = {"a": at(4.0 * frame, noisy(walls, 0.02, rng)), "b": at(4.0 * frame, noisy(frozen, 0.005, rng))}
        refused = set(play(ego, **sent).refused)
        assert "a" not in refused or frame == 1  # before the ego was anywhere else
        repeated += "b" in refused
    assert repeated >= 20


def test_what_another_had_sent_before_is_copied(draw):
    play, first = Frames(draw), draw()
    play(a=at(0.0, first), b=at(9.0, draw()))
    screened = play(a=at(1.0, draw()), b=at(9.0, first))
    assert why(screened) == {"b": (Reason.COPIED, {"of": "a", "of_frame": 0})}
    again = play(a=at(2.0, first), b=at(9.0, first))
    assert why(again) == {"b": (Reason.COPIED, {"of": "a", "of_frame": 0})}


@pytest.mark.parametrize("silent_before", [True, False])
def test_who_is_overheard_while_it_is_silent_is_not_accused_of_what_another_sent_in_its_place(draw, silent_before):
    play, parked = Frames(draw), draw()
    if not silent_before:
        play(owner=at(0.0, draw()), thief=at(9.0, draw()))
    play(thief=at(9.0, parked))
    for _ in range(2 * KEPT_FRAMES):
        assert play(owner=at(0.0, parked), thief=at(9.0, parked)).refused == {}


def test_a_parked_vehicle_that_comes_back_is_not_accused_of_what_it_sent_itself(draw):
    play, parked = Frames(draw), draw()
    play(owner=at(0.0, parked), thief=at(9.0, draw()))
    for _ in range(KEPT_FRAMES):
        play(thief=at(9.0, parked))
    assert "owner" not in play(owner=at(0.0, parked), thief=at(9.0, parked)).refused


def test_a_copy_is_found_as_long_as_it_is_remembered_what_its_sender_sent_then(draw):
    play, parked = Frames(draw), draw()
    for _ in range(KEPT_FRAMES - 1):
        assert play(owner=at(0.0, parked), thief=at(9.0, draw())).refused == {}
    assert set(play(owner=at(0.0, parked), thief=at(9.0, parked)).refused) == {"thief"}
    for _ in range(KEPT_FRAMES):
        assert play(owner=at(0.0, parked), thief=at(9.0, draw())).refused == {}
    assert play(owner=at(0.0, parked), thief=at(9.0, parked)).refused == {}  # nobody knows any more who sent it first


def test_what_was_sent_by_somebody_who_is_silent_now_is_copied_too(draw):
    play, first = Frames(draw), draw()
    play(owner=at(0.0, first), thief=at(9.0, draw()))
    assert why(play(thief=at(9.0, first))) == {"thief": (Reason.COPIED, {"of": "owner", "of_frame": 0})}


def test_the_same_map_in_the_same_frame_accuses_nobody(draw):
    play = Frames(draw)
    for frame in range(4):
        shared = draw()
        screened = play(a=at(frame, shared), b=at(9.0, shared), c=at(30.0, draw()))
        assert screened.refused == {}
        assert [(each.vehicle, each.other, each.of_frame) for each in screened.alike] == [("a", "b", frame)]
        assert screened.alike[0].correlation == 1.0


def test_who_sent_the_same_in_one_frame_may_both_send_it_again(draw):
    play, shared = Frames(draw), draw()
    for _ in range(4):
        assert play(a=at(0.0, shared), b=at(9.0, shared)).refused == {}


def test_who_sends_what_the_ego_sends_has_copied_it(draw):
    play, own = Frames(draw), draw()
    assert why(play(own, a=at(9.0, own))) == {"a": (Reason.COPIED, {"of": EGO, "of_frame": 0})}
    assert why(play(a=at(9.0, own)))["a"] == (Reason.COPIED, {"of": EGO, "of_frame": 0})


def test_maps_that_are_much_alike_are_told_the_most_alike_first(draw, rng):
    shared = draw()
    messages = {f"v{i:02}": at(5.0 * i, noisy(shared, 0.02 * i, rng)) for i in range(9)}
    screened = Frames(draw)(**messages)
    correlations = [each.correlation for each in screened.alike]
    assert correlations == sorted(correlations, reverse=True)
    assert len(correlations) == MOST_TOLD
    assert screened.refused == {}


def test_another_kind_of_ego_message_is_no_reason_to_fail(draw):
    ego = Message(pose_matrix(0, 0, 0, 0), {"grid": np.zeros((4, 4), np.uint8)})
    assert Screening().screen({}, 0, ego, {"a": at(0.0, draw())}).refused == {}
    nothing = KNOWN.screen({"a": {}}, 0, ego, {"a": Message(ego.pose, {})})
    assert (nothing.refused, nothing.memory) == ({}, {"a": {}})


def test_the_memory_is_a_part_of_the_state_of_its_own():
    state = joined({"trusted": ["a"]}, {"a": {"sent": []}})
    assert separated(state) == ({"trusted": ["a"]}, {"a": {"sent": []}})
    assert joined({"trusted": []}, {}) == {"trusted": []}
    assert separated({}) == ({}, {})
