"""What is remembered of lies, and when they are too many."""

import json
import math

import numpy as np
import pytest

from robosac.defenses.group_testing.lies import (
    LONGEST_QUIET,
    MOST_LEVEL,
    MOST_QUIET,
    PLACE_FRAMES,
    QUIET_FRAMES,
    QUIET_M,
    RULES,
    SEARCHED_FRAMES,
    Lies,
    Word,
)
from robosac.defenses.protocol import EGO

HERE = np.array([100.0, -40.0])


def level(lies, kind, name="a"):
    return lies.levels.get(name, {}).get(kind, (0.0, 0.0))[0]


@pytest.mark.parametrize("kind", RULES)
def test_a_level_rises_with_lies_and_sinks_without(kind):
    lies, rule = Lies(), RULES[kind]
    lies.add("a", {kind: 1})
    assert level(lies, kind) == pytest.approx(rule.gain - rule.drift)
    lies.add("a", {kind: 1})
    assert level(lies, kind) == pytest.approx(2 * (rule.gain - rule.drift))
    lies.add("a", {})
    assert level(lies, kind) == pytest.approx(2 * rule.gain - 3 * rule.drift)
    for _ in range(50):
        lies.add("a", {})
    assert lies.levels == {}


@pytest.mark.parametrize("kind", RULES)
def test_after_long_lies_a_level_sinks_as_soon_as_after_short_ones(kind):
    lies, rule = Lies(), RULES[kind]
    for _ in range(1000):
        lies.add("a", {kind: rule.most})
    assert level(lies, kind) == MOST_LEVEL * rule.names > rule.names
    for _ in range(math.ceil(MOST_LEVEL * rule.names / rule.drift)):
        lies.add("a", {})
    assert lies.levels == {}


@pytest.mark.parametrize("kind", RULES)
def test_of_the_lies_of_a_frame_so_many_count(kind):
    one, many = Lies(), Lies()
    one.add("a", {kind: RULES[kind].most})
    many.add("a", {kind: 50})
    assert (
        level(one, kind) == level(many, kind) == pytest.approx(RULES[kind].gain * RULES[kind].most - RULES[kind].drift)
    )


@pytest.mark.parametrize("kind", sorted(kind for kind, rule in RULES.items() if rule.weights))
def test_each_step_weighs_once_on_the_way_up(kind):
    """Not per frame: a mistake repeats itself. From 0 on it counts anew."""
    lies, rule = Lies(), RULES[kind]
    frames = 0
    weights = [0.0]
    while level(lies, kind) < rule.weights[-1][0]:
        weights.append(lies.add("a", {kind: 1}))
        frames += 1
        reached = sum(w for step, w in rule.weights if step <= level(lies, kind) + 1e-9)
        assert sum(weights) == pytest.approx(reached)
    assert sum(weights) == pytest.approx(sum(w for _, w in rule.weights))
    assert lies.add("a", {}) == 0.0
    assert lies.add("a", {kind: 1}) == 0.0  # up there again
    for _ in range(100):
        lies.add("a", {})
    again = sum(lies.add("a", {kind: 1}) for _ in range(frames))
    assert again == pytest.approx(sum(weights))


@pytest.mark.parametrize("kind", sorted(kind for kind, rule in RULES.items() if rule.malice))
def test_who_lies_too_often_in_one_way_is_named(kind):
    lies, rule = Lies(effects={"a": 0}), RULES[kind]
    enough = int(np.ceil(rule.names / (rule.gain - rule.drift) - 1e-9))
    for number in range(1, enough + 1):
        lies.add("a", {kind: 1})
        assert (lies.worst("a") >= 1.0, lies.guilt("a", 0) >= 1.0) == (number == enough,) * 2
    assert lies.worst("b") < 1.0


def test_it_takes_more_words_of_which_nothing_came_to_be_named():
    lies, shares = Lies(), []
    for _ in range(4):
        lies.add("a", {"conflict": 3})
        shares.append(lies.guilt("a", 60))
    assert [share >= 1.0 for share in shares] == [False, False, False, True]
    lies.effects["a"] = 60 - PLACE_FRAMES
    assert lies.guilt("a", 60) == shares[-1]
    lies.effects["a"] += 1
    assert lies.guilt("a", 60) == shares[-1] * MOST_LEVEL
    lies.add("b", {"ghost": 1})
    assert lies.guilt("b", 60) > 0.0


def test_a_place_is_searched_again_after_a_while_only():
    lies, near = Lies(), np.add(HERE, [1.0, 0.0])
    assert lies.search(HERE, 5)
    assert not lies.search(near, 5 + SEARCHED_FRAMES - 1)
    assert lies.search(np.add(HERE, [9.0, 0.0]), 6)
    assert lies.search(near, 5 + SEARCHED_FRAMES)
    assert lies.search(HERE, 0)  # frames are counted anew
    for number in range(100):
        lies.search(np.array([10.0 * number, 50.0]), 1)
    assert len(lies.searched) == MOST_QUIET


def test_who_shows_another_shape_is_neither_suspected_nor_named():
    lies = Lies()
    assert sum(lies.add("a", {"reshaped": 1}) for _ in range(100)) == 0.0
    assert (lies.worst("a") > 1.0, lies.guilt("a", 0)) == (True, 0.0)


def test_who_is_late_is_suspected_and_never_named():
    lies = Lies()
    weights = [lies.add("a", {"late": 1}) for _ in range(100)]
    assert sum(weights) == sum(weight for _, weight in RULES["late"].weights)
    assert (lies.worst("a") > 1.0, lies.guilt("a", 0)) == (True, 0.0)


def test_lies_of_several_kinds_do_not_add_up():
    lies = Lies()
    lies.add("a", dict.fromkeys(RULES, 1))
    assert len(lies.levels["a"]) == len(RULES)
    assert lies.worst("a") < 1.0
    assert lies.worst("a") == max(level(lies, kind) / rule.names for kind, rule in RULES.items())
    assert lies.worst("b") == 0.0


def test_a_place_is_left_alone_for_some_frames():
    lies = Lies()
    assert not lies.is_quiet(HERE, 3)
    lies.leave_alone(HERE, 3)
    assert [lies.is_quiet(HERE, frame) for frame in (3, 3 + QUIET_FRAMES, 4 + QUIET_FRAMES)] == [True, True, False]
    assert lies.is_quiet(HERE + [QUIET_M - 0.1, 0.0], 4)
    assert not lies.is_quiet(HERE + [QUIET_M + 0.1, 0.0], 4)


def test_each_time_for_twice_as_long():
    lies, frame, spans = Lies(), 0, []
    for _ in range(5):
        lies.leave_alone(HERE + [0.5, 0.5], frame)
        until = frame
        while lies.is_quiet(HERE, until + 1):
            until += 1
        spans.append(until - frame)
        frame = until + 1
        assert len(lies.quiet) == 1
    assert spans == [min(LONGEST_QUIET, QUIET_FRAMES * 2**n) for n in range(5)]


def test_places_of_long_ago_are_forgotten_and_the_latest_kept():
    lies = Lies()
    for number in range(2 * MOST_QUIET):
        lies.leave_alone(HERE + [10.0 * number, 0.0], 5)
    assert len(lies.quiet) == MOST_QUIET
    assert lies.is_quiet(HERE + [10.0 * (2 * MOST_QUIET - 1), 0.0], 5)
    assert not lies.is_quiet(HERE, 5)
    lies.leave_alone(HERE, 1000)
    assert len(lies.quiet) == 1


def test_a_place_of_conflict_counts_so_often():
    lies, rule = Lies(), RULES["conflict"]
    near = HERE + [QUIET_M - 0.1, 0.0]
    counted = [lies.counting("a", "conflict", [near if frame else HERE], frame) for frame in range(rule.times + 2)]
    assert counted == [1] * rule.times + [0, 0]
    assert lies.counting("a", "conflict", [HERE], PLACE_FRAMES) == 1
    assert lies.counting("b", "conflict", [HERE], 1) == 1
    assert lies.counting("a", "moved", [HERE], 1) == 1


def test_where_a_place_counts_once_it_counts_once():
    lies = Lies()
    assert [lies.counting("a", "conflict", [HERE], frame, 1) for frame in range(3)] == [1, 0, 0]


def test_of_many_places_as_many_become_known_as_count_in_a_frame():
    lies, most = Lies(), RULES["conflict"].most
    many = [HERE + [10.0 * i, 0.0] for i in range(2 * most)]
    assert lies.counting("a", "conflict", many, 0, 1) == most
    assert lies.counting("a", "conflict", many, 1, 1) == most  # those that did not count
    assert lies.counting("a", "conflict", many, 2, 1) == 0


def test_places_of_long_ago_are_forgotten():
    lies = Lies()
    lies.counting("a", "moved", [HERE], 0)
    lies.counting("a", "conflict", [HERE], 10)
    lies.counting("a", "conflict", [], PLACE_FRAMES)
    assert set(lies.places["a"]) == {"conflict"}
    lies.counting("a", "conflict", [], PLACE_FRAMES + 10)
    assert not lies.places


def test_ghosts_count_always():
    lies = Lies()
    assert [lies.counting("a", "ghost", [HERE], frame) for frame in range(5)] == [1] * 5
    assert not lies.places


@pytest.mark.parametrize("kind", [kind for kind, rule in RULES.items() if rule.times is not None])
@pytest.mark.parametrize("often", [1, 2, 3, 7])
def test_no_mistake_about_one_thing_names_anybody(kind, often):
    lies = Lies()
    for frame in range(0, 300, often):
        lies.add("a", {kind: lies.counting("a", kind, [HERE], frame)})
        assert lies.guilt("a", frame) < 1.0
        for _ in range(often - 1):
            lies.add("a", {})


def test_what_is_remembered_survives_json():
    lies = Lies()
    lies.counting("a", "conflict", [HERE], 3)
    lies.counting("a", "moved", [HERE + 1.0], 4)
    lies.add("a", {"ghost": 1, "conflict": 3})
    lies.add("b", {"moved": 1})
    lies.leave_alone(HERE, 7)
    lies.search(HERE, 7)
    lies.effects = {"a": 7, "b": 3}
    again = Lies.from_state(json.loads(json.dumps(lies.to_state())))
    assert again == lies
    assert again.add("a", {"ghost": 1}) == lies.add("a", {"ghost": 1})
    again.forget("a")
    assert set(again.levels) == set(again.effects) == {"b"}


def test_two_who_say_the_same_again_and_again_are_not_believed():
    lies = Lies()
    assert lies.hear("a", ("b", "c"), 4) is Word.DOUBTFUL
    assert [lies.hear("a", ("c", "b"), 4) for _ in range(3)] == [Word.NOTHING] * 3
    assert lies.hear("a", ("b", "d"), 4) is Word.GOOD  # another one says so, too
    assert lies.hear("a", ("b", "c"), 4) is Word.NOTHING
    assert lies.hear("b", ("c", "d"), 4) is Word.DOUBTFUL  # of somebody else


@pytest.mark.parametrize(
    ("by", "others"), [((EGO, "b"), 4), (("b", "c", "d"), 4), (("b", "c"), 2), ((), 4)], ids=["ego", "3", "all", "none"]
)
def test_whose_word_is_good_at_once(by, others):
    lies = Lies()
    assert [lies.hear("a", by, others) for _ in range(3)] == [Word.GOOD] * 3


def test_who_accused_whom_is_kept_until_that_one_leaves():
    lies = Lies()
    lies.hear("a", ("b", "c"), 4)
    kept = Lies.from_state(json.loads(json.dumps(lies.to_state(), sort_keys=True)))
    assert kept.hear("a", ("b", "c"), 4) is Word.NOTHING
    kept.forget("a")
    assert kept.hear("a", ("b", "c"), 4) is Word.DOUBTFUL
    kept.forget("c")
    assert kept.accusers == {"a": {"b": 1}}
    older = {key: value for key, value in lies.to_state().items() if key != "accusers"}
    assert Lies.from_state(older).accusers == {}
