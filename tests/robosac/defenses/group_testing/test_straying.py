"""Who moves many vehicles a little, over the frames."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Verdict
from robosac.defenses import EGO, Outcome
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.defenses.group_testing.conclusions import conclude
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.frame import JudgedFrame
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.inspection import Inspection
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import QUIET_FRAMES, Lies
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.objects import SLACK_ACROSS_M, Shown
from robosac.defenses.group_testing.posterior import Posterior
from robosac.defenses.group_testing.straying import (
    FEW,
    HEAD_START,
    LEAST_RISE,
    MOST_AT_ONCE,
    MOST_RISE,
    OWN_WORD,
    RULE,
    Straying,
    strays,
)
from robosac.detectors import Message, load
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene
from robosac.session import Session, defense_for
from tests.robosac.defenses.group_testing.conversing import TEAM
from tests.robosac.defenses.group_testing.one_place import HONEST, LIAR, MODEL, SEEN, YES, World, nothing
from tests.robosac.testifying import saying

ASIDE_M = 0.055
"""Too little for testimony to tell of one box, or of all in one frame."""
OTHERS = tuple(name for name in TEAM if name != LIAR)


def aside(boxes, by=ASIDE_M):
    return boxes + [0, by, 0, 0, 0, 0]


def strayed(by, seen=(), speaking=(EGO, *TEAM)):
    """How much the liar strays that moves all boxes by so much; agents may see the vehicles elsewhere."""
    places = [(x, y, YES) for x, y in SEEN[:, :2]]
    testimony = saying({name: places if name in speaking else [] for name in (EGO, *TEAM)}, seen=dict(seen))
    hearing = Hearing(testimony, ())
    return strays(Shown(TEAM, aside(SEEN, by), hearing), Shown(OTHERS, SEEN, hearing), LIAR)


def growth(by):
    """What all boxes count together, of which each was in its place."""
    return min(np.log1p((by / SLACK_ACROSS_M) ** 2), MOST_RISE) * len(SEEN) / np.sqrt(len(SEEN) + FEW)


def test_what_moves_against_the_word_of_others_and_its_own_counts_by_both():
    assert strayed(0.1) == pytest.approx((1 + OWN_WORD) * growth(0.1), rel=0.01)
    assert strayed(0.0) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("by", [0.1, 0.8])
def test_whose_own_word_goes_along_is_wrong_about_its_pose_and_counts_less(by):
    own = OWN_WORD * max(-growth(by), LEAST_RISE)
    assert strayed(by, {LIAR: SEEN[:, :2] + [0, by]}) == pytest.approx(growth(by) + own, rel=0.02)


def test_one_liar_among_the_others_moves_no_median():
    """It says that all vehicles are where an honest teammate does not have them."""
    honest = strayed(0.05)
    assert strayed(0.05, {"car-2": SEEN[:, :2] - [0, 1.0]}) == pytest.approx(honest, abs=0.05)


@pytest.mark.parametrize("speaking", [(), ("car-2",)])
def test_fewer_than_two_others_tell_nothing(speaking):
    assert strayed(0.1, speaking=speaking) == 0.0


def test_of_two_others_each_counts_half():
    seen = {EGO: SEEN[:, :2] - [0, 0.1], "car-2": SEEN[:, :2] + [0, 0.1]}
    assert strayed(0.1, seen, speaking=(EGO, "car-2")) == pytest.approx(growth(0.1), rel=0.01)


def test_boxes_of_different_vehicles_are_not_compared():
    assert strayed(2.0) == 0.0


class Shifting(World):
    """Whoever fuses the liar has all vehicles a little aside."""

    def judge(self, subset, *rest):
        outcome = super().judge(subset, *rest)
        return replace(outcome, boxes=aside(outcome.boxes)) if LIAR in subset else outcome


def test_who_strays_frame_after_frame_is_left_out_and_not_named():
    met = Shifting({}, nothing).play(20)
    assert LIAR in met[0][0].accepted
    assert all(LIAR not in decision.accepted for decision, _ in met[5:])
    assert all(set(OTHERS) <= set(decision.accepted) for decision, _ in met)
    assert not any(decision.named for decision, _ in met)
    last, _ = met[-1]
    added = last.state["memory"]["straying"][LIAR][2]
    assert added == pytest.approx(sum(weight for _, weight in RULE.weights))
    kinds = [item["kinds"] for item in last.state["memory"]["evidence"][LIAR] if item["test"] == "objects"]
    assert kinds
    assert all(kind == {"straying": 1} for kind in kinds)


def test_the_honest_are_asked_again_until_they_proved_harmless_and_no_longer():
    met = HONEST.play(20)
    asked = [sum(len(subset) == len(TEAM) - 1 for subset in tested) for _, tested in met]
    assert asked[2] == MOST_AT_ONCE == max(asked[2:])
    assert not any(asked[17:])
    assert met[-1][0].state["memory"]["straying"] == {}
    assert all(set(decision.accepted) == set(TEAM) for decision, _ in met)


@pytest.mark.parametrize(("beside", "learned"), [(1, False), (3, True)])
def test_beside_few_others_one_message_changes_too_much_to_tell(beside, learned):
    memory, world = Memory(), Shifting({}, nothing)
    found = Findings(Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory), Lies(), TEAM, ())
    small = OTHERS[:beside]
    large = tuple(name for name in TEAM if name in {*small, LIAR})
    for subset in (small, large):
        found.learn(world.judge(subset, None, 0))
    conclude(found, large)
    assert (LIAR in memory.straying.levels) == learned


def after_conclusions(frames, answer):
    """Levels from frame to frame, of whoever strayed, and has not for long been asked beside enough others."""
    memory, lies, world = Memory(straying=Straying({LIAR: (1.5, 1.5)}, {LIAR: 9.0})), Lies(audited={LIAR: 0}), HONEST
    levels = []
    for frame in range(frames):
        memory.frame = frame
        posterior = Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM)
        found = Findings(Knowledge(MODEL, posterior, memory), lies, TEAM, ())
        for subset in {answer, tuple(name for name in TEAM if name in {*OTHERS[:2], LIAR})}:
            found.learn(world.judge(subset, None, frame))
        conclude(found, answer)
        levels.append(memory.straying.levels[LIAR])
    return levels, memory.straying


def test_what_is_known_of_whoever_can_no_longer_be_asked_fades():
    """Where too few others are left, it could never be cleared."""
    levels, straying = after_conclusions(QUIET_FRAMES + 20, OTHERS[:2])
    assert levels[:QUIET_FRAMES] == [(1.5, 1.5)] * QUIET_FRAMES
    assert levels[QUIET_FRAMES + 1] == (pytest.approx(1.5 - 2 * RULE.drift),) * 2
    assert not straying.rising(LIAR)
    assert straying.to_be_asked(TEAM) == [LIAR]
    assert straying.weights == {LIAR: 9.0}
    assert straying.learn(LIAR, 1.0, anew=False) == sum(weight for step, weight in RULE.weights if step <= 1.0)
    in_the_answer, _ = after_conclusions(QUIET_FRAMES + 20, TEAM)
    assert in_the_answer[-1] == (1.5, 1.5)


def test_three_that_were_out_of_place_together_come_back():
    """They strayed, and only two were left to ask them beside."""
    detector, scene = load(), IntersectionScene(1700)
    ego, team = scene.egos[0], sorted(set(scene.agents) - {scene.egos[0]})
    session = Session(detector, team, defense_for(GroupTestingSettings(), detector.info), rng=np.random.default_rng(0))
    accepted = []
    for index in range(56):
        messages = encode_all(detector, scene.frame(index))
        for name in team[2:] if 10 <= index < 20 else ():
            pose = messages[name].pose.copy()
            pose[0, 3] += 1.5
            messages[name] = Message(pose, messages[name].tensors)
        answer = session.answer(index, messages.pop(ego), messages)
        accepted.append(set(answer.accepted))
        assert not answer.named
    assert any(len(of_frame) == 2 for of_frame in accepted)
    assert all(of_frame == set(team) for of_frame in accepted[-2:])


@pytest.mark.parametrize(("size", "level", "asked"), [(6, 0.3, True), (8, 0.3, False), (8, 0.8, True)])
def test_of_a_large_team_only_those_are_asked_again_against_whom_there_is_something(size, level, asked):
    team = tuple(f"v{i}" for i in range(size))
    posterior = Posterior(len(MODEL.kinds), 1e-3, 0.25, team)
    memory = Memory(straying=Straying({"v1": (level, level)}))
    found = Findings(Knowledge(MODEL, posterior, memory), Lies(audited=dict.fromkeys(team, 0)), team, ())
    testimony = saying({name: [(x, y, YES) for x, y in SEEN[:, :2]] for name in (EGO, *team)})
    told = {"testimony": testimony, "alone": SEEN}
    found.learn(Outcome(team, 0.93, Verdict.CONSENSUS, SEEN, SEEN, np.eye(4), 0, **told))
    without = tuple(name for name in team if name != "v1")
    assert Inspection(found, keep_contradicted=False).next_test(team) == (without if asked else None)


def test_who_leaves_is_forgotten():
    memory = Memory(straying=Straying({LIAR: (0.7, 0.7)}))
    memory.leave(LIAR, 0.1, named=False)
    assert memory.straying == Straying()


def test_one_frame_does_not_tell():
    straying = Straying()
    assert straying.learn(LIAR, 5.0, anew=True) == 0.0
    assert straying.rising(LIAR)
    level = HEAD_START + RULE.most - RULE.drift
    assert straying.levels[LIAR] == (pytest.approx(level), 0.0)
    assert straying.learn(LIAR, 0.0, anew=False) == sum(w for step, w in RULE.weights if step <= level - RULE.drift)
    assert straying.learn(LIAR, 0.0, anew=False) == 0.0


def test_nobody_is_named_for_what_straying_adds():
    straying = Straying({LIAR: (1.2, 1.2)})
    straying.note(LIAR, 3.0)
    straying.note(LIAR, 2.0)
    assert straying.without(LIAR, 0.99) == pytest.approx(0.99 / (0.99 + 0.01 * np.exp(5.0)))
    assert straying.without(OTHERS[0], 0.99) == pytest.approx(0.99)
    straying.learn(LIAR, -2.0, anew=False)
    assert straying == Straying()
    straying.note(LIAR, 3.0)
    assert straying == Straying()


@pytest.mark.parametrize("added", [0.0, 9.0])
def test_a_liar_is_named_only_if_more_than_straying_makes_it_suspected(added):
    posterior = Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM)
    memory = Memory(lies=Lies(levels={LIAR: {"ghost": (9.0, 9.0)}}))
    memory.straying = Straying({LIAR: (1.0, 1.0)}, {LIAR: added})
    accusing = np.repeat([0.0, 6.0], [CLEAN, CELLS * len(MODEL.kinds)])
    posterior.update(*(np.array([name in of for name in posterior.members]) for of in ((), (LIAR,))), accusing)
    known = Knowledge(MODEL, posterior, memory)
    frame = JudgedFrame(known, Evidence(known), TEAM, frozenset())
    inspection = Inspection(Findings(known, memory.lies, TEAM, ()), keep_contradicted=False)
    assert frame.decide(frozenset(), 0.99, inspection).named == (() if added else (LIAR,))


def test_whoever_pulls_boxes_to_their_places_is_cleared():
    straying = Straying()
    straying.learn(LIAR, 0.0, anew=True)
    assert straying.to_be_asked(TEAM) == [LIAR]
    straying.learn(LIAR, -1.0, anew=False)
    assert straying.to_be_asked(TEAM) == []
    straying.learn(LIAR, 0.3, anew=False)
    assert straying.levels[LIAR][0] == pytest.approx(0.3 - RULE.drift)


def test_the_worst_few_are_asked_first():
    straying = Straying({name: (level, level) for name, level in zip(TEAM, (0.2, 0.7, 0.1, 0.9, 0.3), strict=True)})
    assert straying.to_be_asked(TEAM) == [TEAM[3], TEAM[1]]
    assert straying.to_be_asked(TEAM[:1]) == [TEAM[0]]


def test_levels_are_kept_and_forgotten():
    straying = Straying()
    straying.learn(LIAR, 0.4, anew=True)
    straying.note(LIAR, 2.0)
    straying.learn("rsu", 0.2, anew=True)
    kept = Straying.from_state(json.loads(json.dumps(straying.to_state())))
    assert kept == straying
    for name in (LIAR, "rsu"):
        kept.forget(name)
    assert kept == Straying()
