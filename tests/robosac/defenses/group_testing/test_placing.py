"""Whose messages lie in a wrong place as a whole."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.attacks import load_campaign
from robosac.boxes import pose_matrix
from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.frame import JudgedFrame
from robosac.defenses.group_testing.fusions import Fusions
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.placing import (
    EGO_MEAN_M,
    EGO_ONCE_M,
    EXPECTED_M,
    FEWEST,
    MEAN_M,
    ONCE,
    ONCE_M,
    RATE,
    Placing,
    ego_misplaced,
    elsewhere,
    misplaced,
)
from robosac.defenses.group_testing.posterior import Posterior
from robosac.detectors import Message, load
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene
from robosac.session import Session, defense_for
from tests.robosac.defenses.group_testing.conversing import TEAM, run_frame
from tests.robosac.defenses.group_testing.conversing import outcome as shown
from tests.robosac.defenses.group_testing.one_place import DEFENSE, HONEST, LIAR, MODEL, SEEN, World, nothing
from tests.robosac.testifying import saying

AGENTS, VEHICLES = 6, 20
WRONG = 3
"""The agent that is out of place."""
RNG = np.random.default_rng(5)
PLACES = RNG.uniform(-30, 30, (VEHICLES, 2))
ORIGINS = RNG.uniform(-20, 20, (AGENTS, 2))
HEARD = np.ones(AGENTS, dtype=bool)


def sees(noise_m=0.0):
    """Where everybody sees all vehicles."""
    return PLACES + np.random.default_rng(7).normal(0, noise_m, (AGENTS, VEHICLES, 2))


def turned(places, origin, degrees):
    return (places - origin) @ pose_matrix(0, 0, 0, np.radians(degrees))[:2, :2].T + origin


def everywhere(shape=(AGENTS, VEHICLES)):
    return np.ones(shape, dtype=bool)


def test_a_shift_and_a_turn_are_told_and_blame_nobody_else():
    centres = sees(0.1)
    centres[WRONG] = turned(centres[WRONG], ORIGINS[WRONG], 2.0) + [0.6, -0.5]
    moved = turned(PLACES, ORIGINS[WRONG], 2.0) + [0.6, -0.5] - PLACES
    off = misplaced(centres, everywhere(), ORIGINS, HEARD)
    assert off[WRONG] == pytest.approx(np.sqrt((moved**2).sum(axis=1).mean()), abs=0.08)
    assert np.isnan(off[0])
    assert (np.delete(off, [0, WRONG]) < 0.1).all()


@pytest.mark.parametrize("shift", [np.zeros(2), np.array([0.7, 0.0])])
def test_what_a_few_vehicles_say_does_not_place_a_message(shift):
    """Somebody that carries two vehicles off by 2 m is where it says, and is not where it does not."""
    centres = sees()
    centres[WRONG] += shift
    centres[WRONG, :2] += [0, 2.0]
    assert misplaced(centres, everywhere(), ORIGINS, HEARD)[WRONG] == pytest.approx(np.hypot(*shift), abs=0.05)


def test_two_out_of_place_together_are_told_and_blame_nobody_else():
    centres = sees(0.1)
    centres[[1, WRONG]] += [0.8, 0.0]
    off = misplaced(centres, everywhere(), ORIGINS, HEARD)
    assert (off[[1, WRONG]] > 0.6).all()
    assert (off[[2, 4, 5]] < 0.2).all()


def test_two_together_outweigh_no_ego():
    """Of vehicles that one other sees beside the two and the ego, the median is theirs."""
    centres, supporting = sees(0.1), everywhere()
    supporting[[2, 4]] = False
    centres[[1, WRONG]] += [0.8, 0.0]
    off = misplaced(centres, supporting, ORIGINS, HEARD)
    assert (off[[1, WRONG]] > 0.6).all()
    assert off[5] < 0.2


def test_each_counts_what_it_sees_itself():
    """What others do not see, or one teammate alone, tells nothing; where nobody looks there may be any number."""
    centres, supporting = sees(), everywhere()
    centres[WRONG] += [0.5, 0.0]
    supporting[:, 8:] = False
    supporting[WRONG, 8:] = True
    supporting[1, 8:12] = True
    centres[~supporting] = np.nan
    centres[1, 8:12] += 5.0
    assert misplaced(centres, supporting, ORIGINS, HEARD)[WRONG] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("count", "told"), [(FEWEST - 1, False), (FEWEST, True)])
def test_a_few_vehicles_tell_nothing(count, told):
    off = misplaced(sees()[:, :count], everywhere((AGENTS, count)), ORIGINS, HEARD)
    assert (~np.isnan(off[1:])).all() == told


def test_the_ego_alone_tells():
    centres, supporting = sees(), everywhere()
    supporting[[1, 2, 4, 5]] = False
    centres[WRONG] += [0.0, 0.9]
    assert misplaced(centres, supporting, ORIGINS, HEARD)[WRONG] == pytest.approx(0.9, abs=0.05)


def test_whoever_is_not_heard_says_nothing_about_others_but_is_placed():
    centres, heard = sees(), HEARD.copy()
    centres[[1, 2, 4]] += [0.0, 1.0]
    heard[[1, 2, 4]] = False
    off = misplaced(centres, everywhere(), ORIGINS, heard)
    assert off[1:] == pytest.approx([0.96, 0.96, 0.0, 0.96, 0.0], abs=0.05)


@pytest.mark.parametrize(("agents", "count"), [(1, 8), (2, 0), (6, 0)])
def test_of_nobody_and_nothing_nothing_is_told(agents, count):
    off = misplaced(np.zeros((agents, count, 2)), everywhere((agents, count)), ORIGINS[:agents], HEARD[:agents])
    assert np.isnan(off).all()


def test_the_ego_is_placed_by_what_others_agree_on():
    assert ego_misplaced(PLACES + [0.8, 0.0], PLACES) == pytest.approx(0.8, abs=0.05)
    turn = turned(PLACES, np.zeros(2), 2.0)
    assert ego_misplaced(turn, PLACES) == pytest.approx(np.sqrt(((turn - PLACES) ** 2).sum(axis=1).mean()), abs=0.1)
    assert ego_misplaced(PLACES, PLACES) < 0.01
    assert np.isnan(ego_misplaced(PLACES[: FEWEST - 1], PLACES[: FEWEST - 1]))


STANDS = pose_matrix(5, -3, 0, np.radians(40))
VIEWED = np.random.default_rng(11).uniform(-20, 20, (14, 2))
NOBODY = np.zeros((0, 2))


def one_sees(places, denied=()):
    """The testimony of one sender that stands at `STANDS`, and where it sees vehicles."""
    said = [*((x, y, 5.5) for x, y in places), *((x, y, -5.0) for x, y in denied)]
    return saying({"": [], LIAR: said}, {LIAR: STANDS}, {LIAR: places}).of({LIAR}), np.asarray(places)


@pytest.mark.parametrize(("shift", "degrees"), [((4.0, 0.0), 0), ((-9.0, 5.0), 0), ((0.0, 0.0), 10), ((3.0, 2.0), -7)])
def test_a_message_that_lies_elsewhere_as_a_whole_is_found(shift, degrees):
    where = turned(VIEWED, STANDS[:2, 3], degrees) + shift
    apart = np.hypot(*(VIEWED[:, None] - where[None]).transpose(2, 0, 1)).min(axis=1)
    said, seen = one_sees(where, VIEWED[apart > 5.0])
    off = np.sqrt(((where - VIEWED) ** 2).sum(axis=1).mean())
    assert elsewhere(said, VIEWED, seen, NOBODY) == pytest.approx(off, abs=0.5)
    stands = turned(STANDS[:2, 3] - shift, STANDS[:2, 3], -degrees)  # where it is in truth
    assert np.isnan(elsewhere(said, VIEWED, seen, np.array([[30.0, 30.0], stands + [0.8, 0.8]])))


def test_a_message_that_lies_where_it_should_is_not_elsewhere():
    assert np.isnan(elsewhere(*swapped(one_sees(VIEWED))))
    liar = one_sees([*VIEWED[:10], (25.0, 25.0), (-25.0, 25.0)], VIEWED[10:])  # four are erased, two made up
    assert np.isnan(elsewhere(*swapped(liar)))


@pytest.mark.parametrize("seed", range(5))
def test_what_shows_other_vehicles_is_not_elsewhere(seed):
    others = np.random.default_rng(seed).uniform(-20, 20, (14, 2))
    apart = np.hypot(*(VIEWED[:, None] - others[None]).transpose(2, 0, 1)).min(axis=1)
    assert np.isnan(elsewhere(*swapped(one_sees(others, VIEWED[apart > 5.0]))))


def test_a_few_vehicles_do_not_tell_where_a_message_lies():
    for count in (0, 1, FEWEST - 1):
        said, seen = one_sees(VIEWED[:count] + [6.0, 0.0], VIEWED[:count])
        assert np.isnan(elsewhere(said, VIEWED[:count], seen, NOBODY))
    assert np.isnan(elsewhere(one_sees(VIEWED)[0], VIEWED, np.zeros((0, 2)), NOBODY))


def swapped(told):
    said, seen = told
    return said, VIEWED, seen, NOBODY


def told(*frames):
    """A placing after frames of how far the liar is off, of a team that is off by .1 m else."""
    placing = Placing()
    for far in frames:
        placing.learn({**dict.fromkeys(TEAM, 0.1), LIAR: far})
    return placing


def test_far_off_is_told_at_once_and_a_little_off_in_time():
    usual = EXPECTED_M + RATE * (0.1 - EXPECTED_M)
    assert told(0.99 * ONCE * usual).out == set()
    assert told(1.01 * ONCE * usual).out == {LIAR}
    assert told(*[0.8 * ONCE_M] * 3).out == set()
    assert told(*[0.8 * ONCE_M] * 20).out == {LIAR}
    assert told(*[0.98 * MEAN_M] * 100).out == set()


def test_what_is_usual_in_the_team_is_no_reason():
    placing = Placing()
    for _ in range(50):
        placing.learn(dict.fromkeys(TEAM, 0.7))
    assert placing.out == set()
    alone = Placing()
    for _ in range(50):
        alone.learn({LIAR: 0.7})
    assert alone.out == {LIAR}


def test_an_ego_far_off_is_told_at_once_and_one_a_little_off_in_time():
    def astray(*frames, differs=False):
        placing = Placing()
        for far in frames:
            placing.learn_ego(far, differs=differs)
        return placing.ego_astray

    assert astray(1.01 * EGO_ONCE_M)
    assert not astray(0.99 * EGO_ONCE_M)
    assert astray(*[0.9 * EGO_ONCE_M] * 10)
    assert not astray(*[0.98 * EGO_MEAN_M] * 100)
    assert astray(np.nan, differs=True)
    assert not astray(2.0, *[np.nan] * 3)


def test_whoever_is_in_place_again_or_can_no_longer_be_placed_is_back():
    others = dict.fromkeys([name for name in TEAM if name != LIAR], 0.1)
    for back in ({LIAR: 0.1}, {}):
        placing = told(*[1.0] * 10)
        assert placing.out == {LIAR}
        frames = 0
        while placing.out and frames < 20:
            placing.learn({**others, **back})
            frames += 1
        assert 3 <= frames <= 10


def test_it_is_kept_and_forgotten():
    placing = told(*[1.0] * 10)
    placing.learn_ego(2.0, differs=False)
    placing.lose([LIAR], 5)
    memory = Memory.from_state(json.loads(json.dumps(Memory(placing=placing).to_state())))
    assert memory.placing == placing
    memory.leave(LIAR, 0.5, named=False)
    assert LIAR not in {*memory.placing.off, *memory.placing.out, *memory.placing.lost}
    assert Memory.from_state({**Memory().to_state(), "placing": {}}).placing == Placing()


class Displaced(World):
    """The liar sees all vehicles elsewhere; what is fused does not show it."""

    def __init__(self):
        super().__init__({}, nothing)
        places = {name: [(x, y, 5.5) for x, y in SEEN[:, :2]] for name in (EGO, *TEAM)}
        self.testimony = saying(places, seen={LIAR: SEEN[:, :2] + [0, 1.0]})


def test_who_is_out_of_place_is_left_out_while_it_is_and_not_suspected():
    met = Displaced().play(10)
    assert all(set(decision.accepted) == set(TEAM) - {LIAR} for decision, _ in met)
    assert not any(decision.named for decision, _ in met)
    last, tested = met[-1]
    assert last.suspicion[LIAR] < 0.1
    assert not any(LIAR in subset for subset in tested)
    assert last.rejected[LIAR].reason is Reason.NOT_SAMPLED
    assert last.rejected[LIAR].evidence["misplaced_m"] == pytest.approx(0.9, abs=0.15)
    assert "misplaced_m" not in HONEST.play(1)[0][0].rejected
    after = HONEST.play(10, before=Displaced(), quiet=10)
    assert LIAR not in after[0][0].accepted
    assert LIAR in after[-1][0].accepted


class Lost(World):
    """The liar sees all vehicles 6 m off, and denies them where they are, in some frames at least."""

    def __init__(self, silent=()):
        super().__init__({}, nothing)
        places = {name: [(x, y, 5.5) for x, y in SEEN[:, :2]] for name in (EGO, *TEAM) if name != LIAR}
        where = SEEN[:, :2] + [6.0, 0.0]
        denied = [(x, y, -5.5) for x, y in SEEN[:, :2]]
        says = {**places, LIAR: [*denied, *((x, y, 5.5) for x, y in where)]}
        self.testimony = saying({EGO: places[EGO], **{n: says[n] for n in TEAM}}, seen={LIAR: where})


def test_whose_message_lies_elsewhere_is_left_out_while_it_does_and_not_named():
    met = Lost().play(12)
    assert all(LIAR not in decision.accepted for decision, _ in met)
    assert not any(decision.named for decision, _ in met)
    last, _ = met[-1]
    assert set(last.accepted) == set(TEAM) - {LIAR}
    assert last.rejected[LIAR].evidence["misplaced_m"] > 3.0
    assert last.state["memory"]["placing"]["lost"] == {LIAR: 5}
    after = HONEST.play(30, before=Lost(), quiet=12)
    assert LIAR in after[-1][0].accepted
    assert not any(decision.named for decision, _ in after)


def test_what_lies_elsewhere_counts_against_nobody_for_some_frames():
    placing = Placing()
    placing.lose([LIAR], 3)
    for left in (2, 1):
        placing.lose([], 3)
        placing.learn({LIAR: 0.1})
        assert placing.lost == {LIAR: left}
        assert placing.out == {LIAR}
    placing.lose([], 3)
    placing.learn({LIAR: 0.1})
    assert placing.lost == {}
    assert placing.out == set()


def test_whose_message_lies_elsewhere_is_excused_and_not_named_whatever_is_known_of_it():
    for lost in ({}, {LIAR: 2}):
        memory = Memory(placing=Placing(lost=dict(lost)))
        known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory)
        assert Fusions(known, TEAM, ()).excused(LIAR) == bool(lost)
        assert not Fusions(known, TEAM, ()).excused("car-2")
        frame = JudgedFrame(known, Evidence(known), TEAM, frozenset())
        memory.lies.guilt = lambda *_: 1.0
        assert frame._is_attacker(LIAR, 0.99, 0.95) == (not lost)


def test_while_the_ego_is_astray_everybody_is_excused_and_whole_fusions_tell_nothing():
    for astray in (False, True):
        memory = Memory(placing=Placing(ego_astray=astray))
        known = Knowledge(MODEL, Posterior(len(MODEL.kinds), 0.5, 0.25, TEAM), memory)
        assert Fusions(known, TEAM, ()).excused(LIAR) == astray
        assert (memory.trust == 0.0) == astray


class EgoAstray(World):
    """Some see all vehicles elsewhere than the ego, all in one place; what is fused shows them half-way."""

    def __init__(self, off, who=TEAM, said=(5.5,) * len(SEEN)):
        super().__init__({}, nothing)
        says = {EGO: said, **dict.fromkeys(TEAM, (5.5,) * len(SEEN))}
        places = {name: [(x, y, L) for (x, y), L in zip(SEEN[:, :2], of, strict=True)] for name, of in says.items()}
        offs = dict(zip(who, off if isinstance(off, tuple) else (off,) * len(who), strict=True))
        self.testimony = saying(places, seen={name: SEEN[:, :2] + [0, by] for name, by in offs.items()})


LEANING = (-2.0,) * len(SEEN)
ASTRAY = [EgoAstray(1.0), EgoAstray(0.0, said=LEANING)]


@pytest.mark.parametrize("world", ASTRAY, ids=["off", "differs"])
def test_an_ego_that_differs_from_all_blames_nobody_and_answers_alone(world):
    met = world.play(10, quiet=10)
    assert not any(decision.named for decision, _ in met)
    assert all(decision.accepted == () for decision, _ in met[1:])
    last, _ = met[-1]
    assert last.source is Source.EGO_ONLY
    assert max(last.suspicion.values()) < 0.1
    assert all(last.rejected[name].evidence["ego_astray"] for name in TEAM)
    assert not any("misplaced_m" in rejection.evidence for rejection in last.rejected.values())
    after = HONEST.play(12, before=world, quiet=10)
    assert set(after[-1][0].accepted) == set(TEAM)


@pytest.mark.parametrize("who", [("car-2", LIAR), ("car-2", "car-3", LIAR)])
def test_some_who_differ_from_the_ego_and_others_do_not_put_it_in_doubt(who):
    """Two do not outweigh it; nor do three that two others contradict."""
    met = EgoAstray(1.0, who).play(10, quiet=10)
    assert not any(decision.state["memory"]["placing"]["ego_astray"] for decision, _ in met)
    assert set(met[0][0].accepted) == set(TEAM) - set(who)


@pytest.mark.parametrize(
    "world",
    [
        EgoAstray(0.0, said=(*LEANING[:3], *(5.5,) * 5)),
        EgoAstray((1.0, -1.0, 0.0, 2.0, -2.0), said=LEANING),
        EgoAstray(0.0, said=(*LEANING[:2], *(0.0,) * 6)),
    ],
    ids=["it supports more", "they disagree", "of two"],
)
def test_an_ego_that_leans_against_some_vehicles_is_where_it_says(world):
    met = world.play(4, quiet=10)
    assert not any(decision.state["memory"]["placing"]["ego_astray"] for decision, _ in met)


def test_whoever_turns_out_to_be_out_of_place_costs_no_pass_beyond_the_budget():
    one = GroupTesting(MODEL, GroupTestingSettings(first_budget=1, budget=1, inspections=0))
    met = Displaced().play(6, one, quiet=30)
    assert all(len(tested) <= 1 for _, tested in met)
    assert LIAR not in met[-1][0].accepted


def test_who_turns_out_to_be_out_of_place_is_not_in_the_answer_of_that_frame():
    """Everybody is cleared: all are fused at once, and nothing else is decoded, until one of them is elsewhere."""
    (quiet, _), (decision, tested) = HONEST.play(1, quiet=30)[0], Displaced().play(1, quiet=30)[0]
    assert set(quiet.accepted) == set(TEAM)
    assert decision.accepted == tuple(name for name in TEAM if name != LIAR)
    assert decision.accepted in tested
    assert decision.source is Source.CONSENSUS


def test_where_only_an_attacker_is_in_place_the_answer_holds_who_turns_out_not_to_be():
    """For that one frame: it was the ego alone."""
    team, rng = (LIAR, "rsu"), np.random.default_rng(0)

    def judge(world):
        def attacked(subset, attackers, frame):
            if "rsu" not in subset:
                return world.judge(subset, attackers, frame)
            told = {"testimony": world.testimony, "alone": world.alone}
            return replace(shown(subset, ["rsu"], frame), verdict=Verdict.CONSENSUS, **told)

        return attacked

    decision, _ = run_frame(DEFENSE, DEFENSE.initial_state(team), team, [], rng, judge=judge(HONEST))
    state, met = json.loads(json.dumps(decision.state)), []
    for _ in range(2):
        decision, tested = run_frame(DEFENSE, state, team, [], rng, judge=judge(Displaced()))
        state = json.loads(json.dumps(decision.state))
        met.append((decision.accepted, {o.teammates for o in tested}, state["memory"]["placing"]["out"]))
    assert met[0][0] == (LIAR,)
    assert ("rsu",) in met[0][1]
    assert met[0][2] == [LIAR]
    assert met[1][0] == ()


def test_whoever_is_alone_is_left_out_too_and_comes_back():
    world, honest, rng = Displaced(), HONEST, np.random.default_rng(0)
    state, accepted = DEFENSE.initial_state([LIAR]), []
    for frame in range(24):
        judge = (world if frame < 12 else honest).judge
        decision, _ = run_frame(DEFENSE, state, (LIAR,), [], rng, judge=judge)
        state = json.loads(json.dumps(decision.state))
        accepted.append(decision.accepted)
    assert accepted[2:12] == [()] * 10
    assert accepted[-1] == (LIAR,)


@pytest.mark.parametrize("others", [("rsu",), ("car-2", "car-3", "rsu")])
def test_whoever_is_out_of_place_beside_attackers_alone_comes_back(others):
    """Nobody else is worth a test; it was never placed again."""

    def judge(world):
        def attacked(subset, attackers, frame):
            return shown(subset, others, frame) if set(others) & set(subset) else world.judge(subset, attackers, frame)

        return attacked

    team, rng = tuple(sorted([LIAR, *others])), np.random.default_rng(0)
    state, accepted = DEFENSE.initial_state(team), []
    for frame in range(40):
        decision, _ = run_frame(DEFENSE, state, team, [], rng, judge=judge(Displaced() if frame < 12 else HONEST))
        state = json.loads(json.dumps(decision.state))
        accepted.append(decision.accepted)
    assert accepted[8:12] == [()] * 4
    assert accepted[-1] == (LIAR,)


def test_without_time_for_a_test_the_answer_goes_without_who_is_out_of_place():
    state = json.loads(json.dumps(Displaced().play(10)[-1][0].state))
    state["trusted"] = sorted(TEAM)
    decision, tested = run_frame(DEFENSE, state, TEAM, [], np.random.default_rng(0), most=0)
    assert tested == []
    assert set(decision.accepted) == set(TEAM) - {LIAR}


def played(campaign, frames=14, number=1700, *, turned_from=None, astray=None):
    """Who is accepted in each frame of a validation scene with one attacker, and who is named. From some frame on the
    ego's heading is wrong by 15 degrees; or the first teammate is not where it says, by a motion (4, 4).
    """
    detector, scene = load(), IntersectionScene(number)
    ego, team = scene.egos[0], sorted(set(scene.agents) - {scene.egos[0]})
    session = Session(detector, team, defense_for(GroupTestingSettings(), detector.info), rng=np.random.default_rng(0))
    accepted, named = [], set()
    for index in range(frames):
        messages = encode_all(detector, scene.frame(index))
        mine = messages.pop(ego)
        if turned_from is not None and index >= turned_from:
            mine = Message(mine.pose @ pose_matrix(0, 0, 0, np.radians(15)), mine.tensors)
        if astray is not None:
            messages[team[0]] = Message(astray @ messages[team[0]].pose, messages[team[0]].tensors)
        lies = load_campaign(campaign).messages(detector, mine, messages, team[:1], index, np.random.default_rng(index))
        answer = session.answer(index, mine, {**messages, **lies})
        accepted.append(set(answer.accepted))
        named |= set(answer.named or ())
    return team, accepted, named


@pytest.mark.parametrize("campaign", ["honest@drifting-pose", "honest@turning-pose"])
def test_a_pose_that_moves_off_slowly_is_found(campaign):
    team, accepted, named = played(campaign, 24)
    assert team[0] in accepted[0]
    assert all(team[0] not in of_frame for of_frame in accepted[20:])
    assert all(set(team[1:]) <= of_frame for of_frame in accepted[20:])
    assert not named


def test_nobody_is_named_where_the_ego_turns_out_not_to_be_where_it_says():
    _, accepted, named = played("honest", 12, 1704, turned_from=5)
    assert not named
    assert all(not of_frame for of_frame in accepted[7:])


@pytest.mark.parametrize("astray", [pose_matrix(3.2, -2.4, 0, 0), pose_matrix(-8, 0, 0, 0)])
def test_a_teammate_that_is_metres_from_where_it_says_is_left_out_and_not_named(astray):
    team, accepted, named = played("honest", 10, 1705, astray=astray)
    assert not named
    assert all(team[0] not in of_frame for of_frame in accepted[1:])
    assert all(set(team[1:]) <= of_frame for of_frame in accepted[2:])
