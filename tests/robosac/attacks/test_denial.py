"""Framing by denial, and ghosts where nobody looks."""

import numpy as np
import pytest

from robosac.attacks import Deny, GhostHidden, NoWitness, Past, Situation
from robosac.boxes import pose_matrix
from robosac.calibrated import witness_of
from robosac.consensus import at_least, compare
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import DENIES, Claims
from robosac.evaluation.encounters import Encounters
from robosac.scenes import IntersectionScene
from tests.robosac.attacks.linear import VEHICLES, Linear, hearing, situation


def test_what_is_denied_is_what_one_honest_teammate_alone_sees():
    surface = Linear()
    west, east = VEHICLES[VEHICLES[:, 0] < 10], VEHICLES[VEHICLES[:, 0] > 20]
    met = situation(surface, truth=VEHICLES)
    denied = Deny().denied(["a"], met)
    assert len(denied) == 4
    assert {tuple(box) for box in denied} in ({tuple(box) for box in west}, {tuple(box) for box in east})
    assert met.memory["victim"] == ("b" if denied[0, 0] < 10 else "c")
    everybody_sees = hearing(surface, at_zero=(6.0, 6.0, 6.0, 6.0))
    assert len(Deny().denied(["a"], situation(surface, truth=VEHICLES, hearing=everybody_sees))) == 0
    assert len(Deny(objects=2).denied(["a"], situation(surface, truth=VEHICLES))) == 2


def test_the_victim_stays_the_victim_while_it_sees_something_alone():
    surface, memory = Linear(), {"victim": "c"}
    one_in_the_east = np.vstack([VEHICLES[VEHICLES[:, 0] < 10], VEHICLES[-1:]])
    np.testing.assert_array_equal(
        Deny().denied(["a"], situation(surface, truth=one_in_the_east, memory=memory)), VEHICLES[-1:]
    )
    west = one_in_the_east[:-1]
    assert len(Deny().denied(["a"], situation(surface, truth=west, memory=memory))) == 4
    assert memory["victim"] == "b"


def test_with_nothing_to_deny_all_are_honest():
    surface, rng = Linear(), np.random.default_rng(0)
    assert Deny().run(surface, ["a"], rng, situation(surface, truth=np.empty((0, 5)))) == {}
    with pytest.raises(NoWitness):
        Deny().run(surface, ["a"], rng, Situation(truth=VEHICLES))


def test_it_denies_what_one_alone_sees_and_leaves_the_fusion_as_it_is(detector):
    witness, attacker, denied = witness_of(detector.info), "car-3", []
    for met in Encounters(detector, IntersectionScene(2)).sequence(3, "deny", [attacker]):
        assert met.lies == ()
        now, honest = (
            Claims.of(met.truth[:, :5], witness.testify(EGO, {EGO: met.ego, **sent}))
            for sent in (met.teammates, met.benign)
        )
        supporting = honest.without([attacker]).supporting
        alone = (supporting.sum(axis=0) == 1) & ~supporting[0]
        own = now.likelihood[now.witnesses.index(attacker)]
        denied.append(bool((alone & (own <= -5.5)).any()))
        assert met.attackers == ({attacker} if denied[-1] else set())
        assert not (own[~alone] < honest.likelihood[now.witnesses.index(attacker)][~alone] - 6.0).any()
        before, after = (met.prepare(met.ego, sent).detect(met.team) for sent in (met.benign, met.teammates))
        assert compare(at_least(before, 0.3), at_least(after, 0.3)).jaccard_index > 0.85
    assert np.mean(denied) > 0.5


def ghost(attack, seed, met):
    attack.run(Linear((6, 6)), ["a"], np.random.default_rng(seed), met)
    return [lie.box for lie in met.lies]


def test_a_hidden_ghost_stands_where_it_is_denied_least_and_stays_there():
    surface = Linear((6, 6))
    truth = np.array([[3.0, -12.0, 4.0, 2.0, 0.0], [-3.0, 14.0, 4.0, 2.0, 0.0]])
    denying_west = hearing(surface, at_zero=(-1.0, 1.0, -5.0, 0.0), gain=0.0)  # b hears of x < 10
    past = Past()
    for seed in range(3):
        met = Situation(truth=truth, hearing=denying_west)
        ((x, *_),) = ghost(GhostHidden(steps=1), seed, met)
        assert x > 10.0
    poses = [pose_matrix(n, 0.0, 1.7, 0.0) for n in range(3)]
    told = []
    for number, pose in enumerate(poses):
        met = Situation(number, ego_pose=pose, memory=past.memory)
        met = Situation(number, ego_pose=pose, truth=met.around_ego(truth), memory=past.memory, hearing=denying_west)
        (box,) = ghost(GhostHidden(steps=1), number, met)
        told.append(met.in_world(box[None])[0])
    np.testing.assert_allclose(told, [told[0]] * 3, atol=1e-9)


def test_of_all_free_places_honest_messages_deny_that_of_a_hidden_ghost_least(detector):
    (met,) = Encounters(detector, IntersectionScene(4)).sequence(1, "ghost-hidden", ["car-3"])
    (other,) = Encounters(detector, IntersectionScene(4)).sequence(1, "ghost", ["car-3"])
    said = witness_of(detector.info).testify(EGO, {EGO: met.ego, **met.benign}).of([EGO, *met.honest])
    hidden, plain = (Claims.of(frame.lies[0].box[None, :5], said).likelihood.sum() for frame in (met, other))
    assert hidden >= plain
    fused = met.prepare(met.ego, met.teammates).detect(met.team)
    near = fused[np.hypot(*(fused[:, :2] - met.lies[0].box[:2]).T) < 1.0]
    assert near[:, 5].max(initial=0.0) > 0.5


def test_a_framing_ghost_is_hidden_with_the_one_that_denies_it_and_shows_without(detector):
    denier, hidden, shown = "", [], []
    for met in Encounters(detector, IntersectionScene(1)).sequence(3, "ghost-framing", ["car-3"]):
        (box,) = (lie.box[:5] for lie in met.lies)
        if not denier:
            said = witness_of(detector.info).testify(EGO, {EGO: met.ego, **met.benign}).of([EGO, *met.honest])
            claimed = Claims.of(box[None], said).likelihood[:, 0]
            denier = said.agents[int(claimed.argmin())]
            assert claimed.min() <= DENIES < np.sort(claimed)[1]
        prepared = met.prepare(met.ego, met.teammates)
        for scores, left_out in ((hidden, ""), (shown, denier)):
            fused = prepared.detect([name for name in met.team if name != left_out])
            scores.append(fused[np.hypot(*(fused[:, :2] - box[:2]).T) < 1.5, 5].max(initial=0.0))
    assert denier in met.honest
    assert max(hidden) < 0.3
    assert min(shown) > 0.5
