"""Whose message is late."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.boxes import pose_matrix
from robosac.defenses import EGO, Outcome
from robosac.defenses.group_testing.defense import COMPARABLE_PERIOD_MS
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.geometry import followed
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lateness import (
    late,
    lately,
    motions,
    moved_since,
    replayed,
    senders,
    sent,
    turned_since,
)
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import TEAM, run_frame
from tests.robosac.defenses.group_testing.one_place import DEFENSE, LIAR, MODEL
from tests.robosac.testifying import saying

MOST = lately(0.2)

YES, NO = 5.5, -7.0
SPEED = np.array([3.0, 0.0])
"""Of all vehicles, metres a frame."""
PLACES = np.array([[-16.0, -12.0], [-14.0, -4.0], [-15.0, 4.0], [-13.0, 12.0]])
"""Where they are in frame 0."""
STILL = np.zeros(2)


def shown_at(places, true=PLACES):
    """What a message says that shows vehicles in other places than where they are."""
    wrong = [(*place, NO) for place, shown in zip(true, places, strict=True) if (place != shown).any()]
    return wrong + [(*place, YES) for place in places]


def told(places, moved=STILL, centres=PLACES, speeds=SPEED):
    """Whether a message is late that shows vehicles in these places."""
    heard = saying({EGO: [], "a": [], "d": shown_at(places, centres if len(centres) else PLACES)})
    return late(heard, "d", np.asarray(moved), centres, np.broadcast_to(speeds, centres.shape))


@pytest.mark.parametrize(("frames", "is_late"), [(0, False), (1, True), (2.5, True), (3, True), (5, False)])
@pytest.mark.parametrize("moved", [(0.0, 0.0), (-2.0, 0.0), (0.0, 3.0)])
def test_a_message_is_late_if_it_fits_best_where_vehicles_were(frames, is_late, moved):
    """With the pose of now, what it shows has moved along with its sender."""
    assert told(PLACES + frames * (moved - SPEED), moved) == is_late


@pytest.mark.parametrize(("frames", "is_late"), [(3.5, True), (4, True), (4.5, False)])
def test_a_message_is_late_up_to_a_bound(frames, is_late):
    assert told(PLACES - frames * SPEED) == is_late


@pytest.mark.parametrize(("frames", "is_late"), [(1, True), (2, True), (5, False)])
def test_with_the_pose_of_then_what_it_shows_has_not_moved_along(frames, is_late):
    assert told(PLACES - frames * SPEED, moved=(0.0, 3.0)) == is_late


@pytest.mark.parametrize(("frames", "vehicles", "is_old"), [(4, None, False), (5, None, True), (5, 2, False)])
def test_an_old_message_shows_most_vehicles_where_they_were(frames, vehicles, is_old):
    heard = saying({EGO: [], "d": [(*place, YES) for place in (PLACES - frames * SPEED)[:vehicles]]})
    assert replayed(heard, "d", STILL, PLACES, np.broadcast_to(SPEED, PLACES.shape)) == is_old


def test_where_nothing_moves_nobody_is_late():
    assert told(PLACES + [-3.0, 0.0], speeds=STILL) is False
    assert told(PLACES + [-3.0, 0.0], centres=PLACES[:0]) is False


@pytest.mark.parametrize(("vehicles", "firmly", "is_late"), [(1, 7.0, False), (2, YES, True), (2, 2.5, False)])
def test_a_message_is_late_by_two_vehicles_at_least_of_which_it_is_sure(vehicles, firmly, is_late):
    heard = saying({EGO: [], "d": [(*place, firmly) for place in PLACES[:vehicles] - SPEED]})
    assert late(heard, "d", STILL, PLACES, np.broadcast_to(SPEED, PLACES.shape)) == is_late


def test_who_sees_something_everywhere_is_not_late():
    heard = saying({EGO: [], "d": [(*place, YES - off) for off in (0, 1) for place in PLACES - (1 - off) * SPEED]})
    assert not late(heard, "d", STILL, PLACES, np.broadcast_to(SPEED, PLACES.shape))


@pytest.mark.parametrize(("speed", "is_late"), [(0.95, False), (1.05, True)])
def test_slow_vehicles_tell_nothing(speed, is_late):
    assert told(PLACES - [2.5 * 1.05, 0.0], speeds=np.array([speed, 0.0])) == is_late


@pytest.mark.parametrize(("moved", "is_late"), [(1, False), (2, False), (3, False), (4, True), (5, True), (6, True)])
def test_a_lie_about_some_vehicles_does_not_excuse_itself(moved, is_late):
    true = np.vstack([PLACES, PLACES[:2] + [20.0, 0.0]])
    places = np.where(np.arange(6)[:, None] < moved, true - 2 * SPEED, true)
    assert told(places, centres=true) == is_late


def test_senders_are_where_their_poses_say():
    ego = pose_matrix(5.0, -3.0, 1.8, 0.7)
    poses = {EGO: ego, "a": pose_matrix(12.004, 8.0, 1.8, -2.0), "b": pose_matrix(-4.0, 1.0, 5.0, 3.0)}
    found = senders(saying(dict.fromkeys(poses, ()), poses), ego)
    assert found == {EGO: (5.0, -3.0, 0.7), "a": (12.0, 8.0, -2.0), "b": (-4.0, 1.0, 3.0)}
    json.dumps(found)


def test_vehicles_are_followed_along_themselves():
    before = np.array([[0.0, 0.0, 0.0, 0.9], [8.0, 0.0, 0.0, 0.9], [20.0, 1.0, 1.5, 0.4]])
    now = np.array([[3.0, 0.1, 0.0, 0.9], [10.0, 0.0, np.pi, 0.9], [20.0, 3.0, -1.6, 0.9]])
    assert motions(now, before) == pytest.approx(np.array([[3.0, 0.1], [2.0, 0.0], [0.0, 2.0]]))
    elsewhere = np.array([[5.5, 0.9, 0.0, 0.9], [-4.6, 0.0, 0.0, 0.9], [8.0, 0.0, 0.5, 0.9]])
    assert np.isnan(motions(elsewhere, before)).all()  # beside the lane, too far, or another heading
    far = before + [[12.0, 0.0, 0.0, 0.0]]
    assert motions(far[:1], before[:1], 2, 0.2) == pytest.approx(np.array([[6.0, 0.0]]))
    assert motions(far[:1], before[:1], 1, 0.4) == pytest.approx(np.array([[12.0, 0.0]]))
    assert np.isnan(motions(far[:1], before[:1], 6, 0.2)).all()  # too long ago
    aside = before[:1] + [[12.0, 1.5, 0.0, 0.0]]
    assert motions(aside, before[:1], 2, 0.2) == pytest.approx(np.array([[6.0, 0.75]]))
    assert np.isnan(motions(before + [[0.0, 1.7, 0.0, 0.0]], before, 2, 0.2)[0]).all()
    assert np.isnan(motions(now, before[:0])).all()
    assert motions(now[:0], before).shape == (0, 2)


def cars(centres):
    return np.column_stack([centres, np.tile([4.5, 1.9, 0.0, 0.9], (len(centres), 1))])


def drive(frames, delay, shown=False, every=1, numbers=None, defense=DEFENSE, speed=SPEED):
    """Decisions in traffic, where one teammate's message is so many frames old, or as old as it is in each frame, and
    shown or not where it is fused. It sends one in every so many frames. The ego asks in those with these ``numbers``.
    """
    delays = delay if callable(delay) else lambda frame: min(delay, frame)
    state, rng, found = defense.initial_state(TEAM), np.random.default_rng(0), []
    for frame in numbers or range(frames):
        true = PLACES + frame * speed
        old = true - delays(frame) * speed
        honest = [(*place, NO) for place in old if delay] + [(*place, YES) for place in true]
        team = tuple(name for name in TEAM if name != LIAR or frame % every == 0)
        said = {**dict.fromkeys((EGO, *TEAM), honest), LIAR: shown_at(old, true)}
        heard = saying({name: said[name] for name in (EGO, *team)})

        def judge(subset, _, __, frame=frame, true=true, old=old, heard=heard):
            more = old if shown and frame and LIAR in subset else old[:0]
            told = {"testimony": heard, "alone": cars(true)}
            return Outcome(
                subset, 0.93, Verdict.CONSENSUS, cars(np.vstack([true, more])), cars(true), np.eye(4), frame, **told
            )

        decision, _ = run_frame(defense, state, team, [], rng, judge=judge)
        state = json.loads(json.dumps(decision.state))
        found.append(decision)
    return found


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("shown", [False, True])
@pytest.mark.parametrize(("delay", "names"), [(0, set()), (1, set()), (2, set()), (5, {LIAR})])
def test_who_is_late_is_not_named_and_who_replays_is(delay, names, shown, every):
    """Nor is who sends a late message in every other frame."""
    found = drive(6 + 4 * every, delay, shown and delay > 0, every)
    assert {name for decision in found for name in decision.named} == names
    levels = found[-1].state["memory"]["lies"]["levels"].get(LIAR, {})
    assert ("late" in levels) == (0 < delay < 5) or delay == 5  # it was, while it had nothing older
    assert ("conflict" in levels) == (delay == 5)
    assert ("ghost" in levels) == (delay == 5 and shown)
    assert not any(decision.state["memory"]["placing"]["lost"] for decision in found)  # late, or old, not elsewhere


@pytest.mark.parametrize(
    ("delay", "names"),
    [
        (lambda frame: min(frame // 3, 4), set()),  # a clock that goes slower
        (lambda frame: frame % 5, set()),  # one message in five frames, sent again and again
        (lambda frame: 4 * (frame >= 4), set()),
        (lambda frame: 5 * (frame >= 5), {LIAR}),
        (lambda frame: min(frame // 2, 6), {LIAR}),
    ],
    ids=["slower", "again", "at once", "at once too late", "too late"],
)
def test_who_is_late_is_not_named_up_to_a_bound(delay, names):
    found = drive(16, delay, shown=True)
    assert {name for decision in found for name in decision.named} == names


@pytest.mark.parametrize(("delay", "names"), [(2, set()), (5, {LIAR})])
def test_who_is_late_and_sends_rarely_is_not_named_and_who_replays_is(delay, names):
    found = drive(37, delay, shown=True, every=6, speed=SPEED / 3)
    assert {name for decision in found for name in decision.named} == names


@pytest.mark.parametrize("delay", [1, 2, 5])
@pytest.mark.parametrize(
    ("numbers", "period_ms"),
    [
        (range(0, 14, 2), 200.0),
        (range(0, 18, 3), 200.0),
        ([0, 1, 3, 4, 5, 8, 9, 11, 13], 200.0),
        (range(0, 18, 4), 100.0),
        (range(8), 300.0),
        (range(8), 400.0),
        (range(0, 20, 4), 200.0),
    ],
)
def test_where_frames_are_missing_or_far_apart_nobody_who_is_late_is_named(numbers, period_ms, delay):
    settings = DEFENSE.settings.model_copy(
        update={"frame_period_ms": period_ms, "compare_frames": period_ms <= COMPARABLE_PERIOD_MS}
    )
    found = drive(0, delay, shown=True, numbers=numbers, defense=replace(DEFENSE, settings=settings))
    is_late = delay * period_ms <= 800
    assert {name for decision in found for name in decision.named} == (set() if is_late else {LIAR})


def test_where_senders_were_is_known_for_some_seconds():
    assert [lately(period_s) for period_s in (0.001, 0.05, 0.2, 0.5, 1.0, 5.0)] == [250, 100, 25, 10, 5, 5]
    state = drive(2, 0)[-1].state
    assert state["memory"]["senders"] == {name: [0.0, 0.0, 1, 0.0, 0.0] for name in (EGO, *TEAM)}
    for frames, last in ((MOST, 0), (MOST + 1, None)):
        kept = drive(frames, 0, every=100)[-1].state["memory"]["senders"]
        assert kept.get(LIAR) == (None if last is None else [0.0, 0.0, last, 0.0, 0.0])
        assert kept[EGO] == [0.0, 0.0, frames - 1, 0.0, 0.0]


def test_who_leaves_is_nowhere_when_another_of_that_name_joins():
    memory = Memory(senders={"a": (1.0, 2.0, 6, 0.5, 0.1), "b": (1.0, 2.0, 6, 0.5, 0.1)})
    memory.leave("a", 0.1, named=False)
    assert set(memory.senders) == {"b"}


def test_how_fast_a_sender_is_shows_from_where_it_was_lately():
    def moved(last, number):
        found = moved_since(last and (*last, None, 0.0), (16.0, -2.0, 0.0), number, MOST)
        return None if found is None else found.tolist()

    assert moved((10.0, 4.0, 8), 9) == [6.0, -6.0]
    assert moved((10.0, 4.0, 8), 11) == [2.0, -2.0]
    assert moved((10.0, 4.0, 8), 8 + MOST) is not None
    assert moved((10.0, 4.0, 8), 9 + MOST) is None
    assert moved((10.0, 4.0, 8), 8) is None  # numbers that begin again
    assert moved(None, 9) is None
    assert moved_since((10.0, 4.0, 8, None, 0.0), None, 9, MOST) is None


@pytest.mark.parametrize(("sender", "before", "counts"), [("a", 0.0, True), (EGO, 0.0, False), (EGO, 0.1, True)])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_ego_that_begins_to_turn_so_fast_is_not_where_it_says(sender, before, counts, sign):
    memory = Memory(senders={sender: (0.0, 0.0, 0, 0.0, sign * before)})
    found = Findings(Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory), Lies(), TEAM, ())
    found.number, found.senders = 1, {sender: (0.0, 0.0, sign * 0.2)}
    assert found._turned(sender) == pytest.approx(sign * 0.2 if counts else 0.0)
    assert sent(memory.senders, found.senders, 1, MOST)[sender][4] == pytest.approx(sign * 0.2)


def test_how_fast_a_sender_turns_shows_so_too():
    def turned(yaw, number, now=(0.0, 0.0, -3.0)):
        return turned_since((0.0, 0.0, 8, yaw, 0.0), now, number, MOST)

    assert turned(3.0, 9) == pytest.approx(2 * np.pi - 6)
    assert turned(-2.6, 10) == pytest.approx(-0.2)
    assert [turned(None, 9), turned(3.0, 8), turned(3.0, 9 + MOST), turned(3.0, 9, None)] == [0.0] * 4
    assert turned_since(None, (0.0, 0.0, -3.0), 9, MOST) == 0.0


@pytest.mark.parametrize("yaw_rate", [0.4, -0.4])
@pytest.mark.parametrize("delay", [1, 2, 5])
def test_a_sender_that_turns_shows_all_turned_about_itself(yaw_rate, delay):
    """It drives on while vehicles do, and sends what it saw then with its pose of now."""
    moved, origin = np.array([0.0, 2.0]), np.array([-4.0, 1.0])
    c, s = np.cos(delay * yaw_rate), np.sin(delay * yaw_rate)
    places = origin + (PLACES - delay * SPEED - origin + delay * moved) @ np.array([[c, s], [-s, c]])
    said = {EGO: [], "a": [], "d": shown_at(places)}
    heard = saying(said, {name: pose_matrix(*(origin if name == "d" else STILL), 0.0, 0.0) for name in said})
    still = np.broadcast_to(SPEED, PLACES.shape)
    assert late(heard, "d", moved, PLACES, still, yaw_rate) == (delay < 5)
    assert delay == 1 or not late(heard, "d", moved, PLACES, still)  # so little may fit a longer way straight on


def test_older_versions_kept_senders_of_the_latest_frame_without_its_number():
    state = Memory(shown_in=7, senders={"a": (1.0, 2.0, 6, 0.5, 0.1)}).to_state()
    assert Memory.from_state(state).senders == {"a": (1.0, 2.0, 6, 0.5, 0.1)}
    assert Memory.from_state({**state, "senders": {"a": [1.0, 2.0, 6]}}).senders == {"a": (1.0, 2.0, 6, None, 0.0)}
    assert Memory.from_state({**state, "senders": {"a": [1.0, 2.0]}}).senders == {"a": (1.0, 2.0, 7, None, 0.0)}


POSE = pose_matrix(100.0, -50.0, 1.8, 1.2)
REST = tuple(name for name in TEAM if name != LIAR)


def asked(true, late, fused, alone, ego_moved=STILL, forget=None, beside=(), speed=SPEED, period_s=0.2, turned=0.0):
    """Findings of a frame: what is true, and what the liar's message shows; boxes of the team's rest, and of the ego.

    Everybody stands where the ego does. Before that the ego was elsewhere by what it has moved.
    """
    turn, origin = POSE[:2, :2], POSE[:2, 3]
    memory = Memory(
        senders=dict.fromkeys(TEAM, (*origin, 0, None, 0.0)) | {EGO: (*(origin - turn @ ego_moved), 0, None, 0.0)}
    )
    known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory, period_s)
    before = followed(cars(true - speed), POSE)
    memory.shown = {} if forget == "shown" else {known.key(subset): before for subset in ((), REST, tuple(TEAM))}
    memory.senders[LIAR] = (*origin, 0, 1.2 - turned, 0.0)
    memory.senders.pop(forget, None)
    own = [(*-ego_moved, YES)] if np.any(ego_moved) else []
    said = {EGO: shown_at(true, true), "car-2": shown_at(true, true), LIAR: [*shown_at(late, true), *own]}
    found = Findings(known, Lies(), TEAM, ())
    told = {"testimony": saying({**dict.fromkeys(TEAM, ()), **said}), "alone": alone}
    for subset, boxes in ((REST, fused), *beside):
        found.learn(Outcome(subset, 0.9, Verdict.CONSENSUS, boxes, alone, POSE, 1, **told))
    return found


@pytest.mark.parametrize("by", ["fused", "alone", "nobody"])
@pytest.mark.parametrize("forget", [None, "shown", EGO, LIAR])
def test_who_is_late_is_told_by_what_others_see_or_by_what_the_ego_sees_alone(by, forget):
    """Where all others are late, too, their boxes are not where vehicles are."""
    boxes = {name: cars(PLACES if name == by else PLACES + [20.0, 0.0]) for name in ("fused", "alone")}
    found = asked(PLACES, PLACES - SPEED, **boxes, forget=forget)
    assert found.late(LIAR) == (by != "nobody" and forget is None)
    assert not found.late("car-2")


@pytest.mark.parametrize(
    ("period_s", "frames", "is_late"),
    [(0.2, 1, True), (0.05, 4, True), (0.05, 10, True), (0.05, 20, False), (0.25, 0.8, True), (0.25, 4, False)],
)
def test_delays_count_in_seconds_however_far_apart_frames_are(period_s, frames, is_late):
    """Up to half a second; vehicles drive at 15 m/s."""
    speed = SPEED * period_s / 0.2
    found = asked(PLACES, PLACES - frames * speed, *[cars(PLACES)] * 2, speed=speed, period_s=period_s)
    assert found.late(LIAR) == is_late


@pytest.mark.parametrize("turned", [0.4, -0.4, 0.0])
def test_who_turns_is_late_if_all_that_it_shows_is_turned(turned):
    c, s = np.cos(0.8), np.sin(0.8)
    two_frames_ago = (PLACES - 2 * SPEED) @ np.array([[c, s], [-s, c]])
    assert asked(PLACES, two_frames_ago, *[cars(PLACES)] * 2, turned=turned).late(LIAR) == (turned > 0)


def test_the_ego_is_a_vehicle_that_a_late_message_shows():
    one = PLACES[:1]
    for ego_moved, is_late in ((SPEED, True), (STILL, False)):
        assert asked(one, one - SPEED, cars(one), cars(one), ego_moved).late(LIAR) == is_late


def test_of_fusions_with_the_sender_in_it_nothing_is_told():
    nothing = cars(PLACES + [20.0, 0.0])
    found = asked(PLACES, PLACES - SPEED, cars(PLACES), nothing, beside=[(tuple(TEAM), nothing)])
    assert found.late(LIAR)


@pytest.mark.parametrize(("said_by", "score", "is_late"), [(LIAR, 0.9, True), ("all", 0.45, True), ("all", 0.9, False)])
def test_boxes_that_nobody_else_supports_or_that_are_faint_tell_nothing(said_by, score, is_late):
    """The sender sees three more a little ahead of where they are."""
    more = PLACES[:3] + [20.0, 0.0]
    everything = np.vstack([PLACES, more])
    late = np.vstack([PLACES - SPEED, more + SPEED / 2])
    boxes = cars(everything)
    boxes[4:, 5] = score
    found = asked(everything, late, boxes, cars(PLACES + [0.0, 30.0]))
    if said_by == LIAR:
        words, found.hearing = {EGO: shown_at(PLACES, PLACES), LIAR: shown_at(late, everything)}, None
        told = {"testimony": saying({**dict.fromkeys(TEAM, ()), **words}), "alone": boxes[:0]}
        found.learn(Outcome(REST, 0.9, Verdict.CONSENSUS, boxes, boxes[:0], POSE, 1, **told))
    assert found.late(LIAR) == is_late


def ego_found(ego_delay=1, seeing=("car-2", "car-3", "rsu"), aside=0.0, unheard=()):
    """Findings of a frame in which some see all vehicles, the last of them aside, and the ego where they were."""
    memory = Memory(senders=dict.fromkeys((EGO, *TEAM), (0.0, 0.0, 0, None, 0.0)))
    known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory)
    memory.shown = {known.key(tuple(TEAM)): followed(cars(PLACES - SPEED), np.eye(4))}
    says = {EGO: shown_at(PLACES - ego_delay * SPEED)}
    says |= {name: [(*place, YES) for place in PLACES] for name in seeing}
    found = Findings(known, Lies(), TEAM, unheard)
    heard = saying({**dict.fromkeys((EGO, *TEAM), ()), **says}, seen={seeing[-1]: PLACES + [0.0, aside]})
    told = {"testimony": heard, "alone": cars(PLACES - ego_delay * SPEED)}
    found.learn(Outcome(tuple(TEAM), 0.9, Verdict.CONSENSUS, cars(PLACES), told["alone"], np.eye(4), 1, **told))
    return found


@pytest.mark.parametrize(("delay", "late_by_it"), [(0, False), (1, True), (2, True), (5, False), (-1, False)])
def test_the_ego_is_late_if_three_teammates_see_all_vehicles_farther_on(delay, late_by_it):
    assert ego_found(delay).ego_late == late_by_it


def test_two_teammates_and_those_who_differ_do_not_make_the_ego_late():
    assert not ego_found(seeing=("car-2", "car-3")).ego_late
    assert ego_found(aside=0.8).ego_late
    assert not ego_found(aside=1.0).ego_late
    assert ego_found(unheard=("car-2",)).ego_late
    assert not Findings(ego_found().known, Lies(), TEAM, ()).ego_late


def deny(frames, ego_delay):
    """Decisions in traffic that one teammate denies, where the ego's message is so many frames old."""
    state, rng, found = DEFENSE.initial_state(TEAM), np.random.default_rng(0), []
    for frame in range(frames):
        true = PLACES + frame * SPEED
        own = shown_at(true - min(ego_delay, frame) * SPEED, true)
        says = {name: [(*place, NO if name == LIAR else YES) for place in true] for name in TEAM}
        heard = saying({EGO: own, **says})

        def judge(subset, _, number, true=true, heard=heard):
            told = {"testimony": heard, "alone": cars(true)}
            return Outcome(subset, 0.93, Verdict.CONSENSUS, cars(true), cars(true), np.eye(4), number, **told)

        decision, _ = run_frame(DEFENSE, state, TEAM, [], rng, judge=judge)
        state = json.loads(json.dumps(decision.state))
        found.append(decision)
    return found


@pytest.mark.parametrize(("delay", "names", "since"), [(0, {LIAR}, None), (1, set(), 7), (2, set(), 7)])
def test_beside_a_late_ego_nobody_is_named(delay, names, since):
    found = deny(8, delay)
    assert {name for decision in found for name in decision.named} == names
    assert found[-1].state["memory"]["ego_late"] == since
    assert all(EGO in judged.support.witnesses for judged in found[0].objects)
    heard = [EGO in (*judged.support.witnesses, *judged.support.deniers) for judged in found[-1].objects]
    assert any(heard) == (delay == 0)


def test_an_ego_that_was_late_is_heard_again_in_time():
    state = deny(4, 1)[-1].state
    silent = []
    for _ in range(9):
        memory = Memory.from_state(state["memory"])
        silent.append(memory.ego_is_late)
        state["memory"]["frame"] += 1
    assert silent == [True] * 5 + [False] * 4
    del state["memory"]["ego_late"]  # as in the states of older versions
    assert not Memory.from_state(state["memory"]).ego_is_late
