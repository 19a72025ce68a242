import numpy as np
import pytest
import torch

from robosac.attacks import (
    ATTACKS,
    Displace,
    Ghost,
    GhostAhead,
    GhostBeside,
    GhostDriving,
    Ghosts,
    Lie,
    Past,
    Remove,
    Situation,
    Swarm,
)
from robosac.attacks.objects import CRISP, FAINT, GONE, OnObjects
from robosac.attacks.places import CLEARANCE_M, REACH_M, Followed
from robosac.boxes import pairwise_iou, pose_matrix
from robosac.evaluation.encounters import Encounters
from robosac.scenes import IntersectionScene
from tests.robosac.attacks.linear import Linear, hearing

ON_OBJECTS = [attack for attack in ATTACKS.values() if issubclass(attack, OnObjects)]
SHAPE = (6, 6)


@pytest.fixture
def surface():
    """A street of places 10 m apart. The ego sees none of the cars, teammate c those at (0, 10) and (20, 20)."""
    linear = Linear(SHAPE)
    linear.ego = torch.full(SHAPE, -6.0)
    linear.messages = {name: torch.zeros(SHAPE) for name in "abc"}
    linear.messages["c"][1, 0] = linear.messages["c"][2, 2] = 9.0
    return linear


def car(x, y, yaw=0.0):
    return np.array([x, y, 4.5, 1.9, yaw])


def street(surface, *more):
    """Where the cars are that c sees, and further ones."""
    with torch.no_grad():
        logits, boxes = surface.perceive(surface.messages)
    return np.array([car(*box[:2]) for box in boxes[logits > 0].tolist()] + list(more))


def strike(attack, surface, met, attackers=("a",)):
    """Logits and boxes of the attacked fusion."""
    sent = attack.run(surface, list(attackers), np.random.default_rng(0), met)
    with torch.no_grad():
        return surface.perceive({**surface.messages, **sent})


@pytest.mark.parametrize("attackers", [("a",), ("a", "b")])
def test_a_ghost_is_crisp_where_it_is_said_to_be_and_all_else_stays(surface, attackers):
    met = Situation(truth=street(surface, car(30.0, -5.0)))
    logits, _ = strike(Ghost(epsilon=9.0, steps=120, step_size=0.1), surface, met, attackers)
    (lie,) = met.lies
    assert lie.kind == "ghost"
    before = surface.class_logits(surface.messages)
    new = (logits > 0) & (before <= 0)
    assert int(new.sum()) == 1
    assert float(logits[new]) > CRISP - 0.3
    assert (logits[before > 0] > 1.5).all()
    y, x = (10.0 * int(n) for n in new.nonzero()[0])
    assert np.hypot(x - lie.box[0], y - lie.box[1]) < 8.0


def test_an_erased_car_is_gone_and_the_other_stays(surface):
    met = Situation(truth=street(surface))
    logits, _ = strike(Remove(epsilon=15.0, steps=120, step_size=0.15), surface, met)
    (lie,) = met.lies
    assert lie.kind == "erased"
    first, second = logits[1, 0], logits[2, 2]
    erased, other = (first, second) if lie.box[0] < 10 else (second, first)
    assert float(erased) < GONE + 0.5
    assert float(other) > 2.0


def test_a_displaced_car_is_shown_to_its_left(surface):
    met = Situation(truth=street(surface))
    _, boxes = strike(ATTACKS["displace"](epsilon=9.0, steps=120, step_size=0.1), surface, met)
    (lie,) = met.lies
    np.testing.assert_allclose(lie.box[:2] - lie.truth[:2], [0.0, 1.2], atol=1e-9)
    row, column = (1, 0) if lie.box[0] < 10 else (2, 2)
    assert float(boxes[row, column, 1]) == pytest.approx(lie.box[1], abs=0.3)


def test_a_dimmed_car_is_hardly_shown_and_the_other_stays(surface):
    met = Situation(truth=street(surface))
    logits, _ = strike(ATTACKS["dim"](epsilon=15.0, steps=120, step_size=0.15), surface, met)
    (lie,) = met.lies
    assert lie.kind == "dimmed"
    first, second = logits[1, 0], logits[2, 2]
    dimmed, other = (first, second) if lie.box[0] < 10 else (second, first)
    assert float(dimmed) == pytest.approx(FAINT, abs=0.5)
    assert float(other) > 2.0


def test_a_car_that_no_box_shows_can_be_dimmed_no_further(surface):
    class Far(OnObjects):
        name = "far"

        def lies(self, scope, rng):
            return [Lie("dimmed", car(900.0, 900.0))]

    met = Situation(truth=street(surface))
    before, _ = surface.perceive(surface.messages)
    logits, _ = strike(Far(steps=2), surface, met)
    assert met.lies
    np.testing.assert_allclose(logits, before.detach(), atol=1.0)


def test_a_car_jumps_ahead(surface):
    met = Situation(truth=street(surface))
    strike(ATTACKS["jump"](steps=1), surface, met)
    (lie,) = met.lies
    yaw = lie.truth[4]
    np.testing.assert_allclose(lie.box, lie.truth + [3.3 * np.cos(yaw), 3.3 * np.sin(yaw), 0, 0, 0], atol=1e-9)


def test_a_ghost_beside_a_car_drives_with_it_and_keeps_off_the_others(surface):
    """Beside the second of two cars that are shown another one stands."""
    (first, second), speed = street(surface), np.array([1.5, 0, 0, 0, 0])
    truths = [np.array([first + n * speed, second, second + [0, 3.5, 0, 0, 0]]) for n in range(4)]
    told = frames(GhostBeside(steps=1), surface, truths, [np.eye(4)] * 4)
    np.testing.assert_allclose(told, [[truth[0] + [0, 3, 0, 0, 0]] for truth in truths], atol=1e-9)


def test_a_ghost_beside_a_car_is_given_up_where_it_gets_too_close(surface):
    """Something drives up to the ghost. It stays from 3 m on; nearer, there is one beside the other car."""
    first, second = street(surface)
    for passing, left_m in ((3.1, True), (2.9, False)):
        truths = [np.array([first, second, first + [0, 3 + away, 0, 0, 0]]) for away in (20.0, passing)]
        told = frames(GhostBeside(steps=1), surface, [truth[[0, 2]] for truth in truths], [np.eye(4)] * 2)
        assert len(told[0]) == 1
        assert len(told[1]) == left_m
        (again,) = frames(GhostBeside(steps=1), surface, truths[1:], [np.eye(4)])[0]
        np.testing.assert_allclose(again, second + [0, 3, 0, 0, 0], atol=1e-9)


def test_a_ghost_beside_a_car_is_not_where_an_agent_is_nor_far_away(surface):
    first, second = street(surface)
    agent = first + [0, 6, 0, 0, 0]
    met = Situation(truth=np.array([first, second]), poses={"a": pose_matrix(*agent[:2], 1.7, 0.0)})
    strike(GhostBeside(steps=1), surface, met)
    np.testing.assert_allclose(met.lies[0].box, second + [0, 3, 0, 0, 0], atol=1e-9)
    leaving = [np.array([first + [x, 0, 0, 0, 0]]) for x in (0.0, 4.0)]
    driven = [pose_matrix(-28.0 * n, 0.0, 1.7, 0.0) for n in range(2)]  # 32 m behind the car
    assert [len(lies) for lies in frames(GhostBeside(steps=1), surface, leaving, driven)] == [1, 0]


def far_aside():
    """An attack by its place."""
    return Displace(distance=2.1)


@pytest.mark.parametrize("attack", ["jump", f"{__name__}:{far_aside.__name__}"], ids=["ahead", "aside"])
def test_a_car_that_is_moved_far_is_gone_where_it_is(attack, detector):
    met = Encounters(detector, IntersectionScene(2)).sequence(3, attack, ["car-3", "rsu"])[-1]
    (lie,) = met.lies
    boxes = met.prepare(met.ego, met.teammates).detect(met.team)
    from_true, from_lie = (np.hypot(*(boxes[:, :2] - box[:2]).T) for box in (lie.truth, lie.box))
    assert boxes[from_true < 1.0, 5].max(initial=0.0) < 0.3
    assert boxes[from_lie < 1.0, 5].max(initial=0.0) > 0.5


@pytest.mark.parametrize(
    ("attack", "shape"),
    [("turn", lambda box: box + [0, 0, 0, 0, np.pi / 4]), ("stretch", lambda box: box * [1, 1, 1.7, 1.7, 1])],
)
def test_a_car_is_shown_with_another_heading_or_size_where_it_is(attack, shape, detector):
    for met in Encounters(detector, IntersectionScene(2)).sequence(2, attack, ["car-3", "rsu"]):
        (lie,) = met.lies
        assert lie.kind == "reshaped"
        np.testing.assert_allclose(lie.box, shape(lie.truth))
        boxes = met.prepare(met.ego, met.teammates).detect(met.team)
        like_lie, like_truth = pairwise_iou(np.array([lie.box, lie.truth]), boxes)
        assert like_lie.max() > like_truth.max() > 0.2
        rest = [box for box in met.truth if np.hypot(*(box[:2] - lie.truth[:2])) > 3.0]
        honest = met.prepare(met.ego, met.benign).detect(met.team)
        seen = pairwise_iou(np.array(rest), honest).max(axis=1) > 0.5
        assert (pairwise_iou(np.array(rest), boxes).max(axis=1) > 0.5)[seen].mean() > 0.8


def test_a_car_that_the_ego_sees_is_left_alone(surface):
    surface.ego[1, 0] = surface.ego[2, 2] = 5.0
    met = Situation(truth=street(surface))
    assert Remove().run(surface, ["a"], np.random.default_rng(0), met) == {}
    assert met.lies == []


@pytest.mark.parametrize("attack", ON_OBJECTS, ids=lambda attack: attack.name)
def test_a_lie_keeps_its_distance_or_is_about_a_car(attack, surface):
    truth = street(surface, car(20.0, -9.0, 1.5), car(-12.0, 3.0, 0.4))
    poses = {"a": pose_matrix(-6, -6, 1.7, 0.0), "b": pose_matrix(9, -3, 1.7, 0.0), "c": pose_matrix(0, 5, 1.7, 0.0)}
    met = Situation(truth=truth, poses=poses, hearing=hearing(surface))
    attack(steps=1).run(surface, ["a"], np.random.default_rng(1), met)
    agents = np.array([[0.0, 0.0], *(pose[:2, 3] for pose in poses.values())])
    ghosts = [lie.box[:2] for lie in met.lies if lie.kind == "ghost"]
    beside = attack is GhostBeside
    for number, ghost in enumerate(ghosts):
        others = np.vstack([truth[:, :2], agents, *(g[None] for n, g in enumerate(ghosts) if n != number)])
        apart = np.sort(np.hypot(*(others - ghost).T))
        assert apart[0] == pytest.approx(3.0) if beside else apart[0] >= CLEARANCE_M
        assert apart[1] >= 4.0
        assert np.hypot(*ghost) <= REACH_M
    for lie in met.lies:
        if lie.kind != "ghost":
            about = lie.box if lie.truth is None else lie.truth
            assert np.abs(truth - about).max(axis=1).min() < 1e-6
    assert met.lies


def frames(attack, surface, truths, poses, period_s=0.2, start=0):
    """The lies of successive frames; true boxes are given in the world frame."""
    past, told = Past(period_s), []
    for number, (truth, pose) in enumerate(zip(truths, poses, strict=True)):
        met = Situation(start + number, period_s, pose, memory=past.memory)
        met = Situation(start + number, period_s, pose, truth=met.around_ego(truth), memory=past.memory)
        attack.run(surface, ["a"], np.random.default_rng(number), met)
        told.append([met.in_world(lie.box[None])[0] for lie in met.lies])
    return told


STANDING = np.array([car(12.0, -4.0), car(-9.0, 6.0, 2.0)])
MOVES = [pose_matrix(1.5 * n, 0.2 * n, 1.7, 0.02 * n) for n in range(3, 7)]


@pytest.mark.parametrize("attack", [Ghost, GhostAhead, Ghosts, Swarm], ids=lambda attack: attack.name)
def test_what_stands_stands_in_the_world(attack, surface):
    told = frames(attack(steps=1), surface, [STANDING] * 4, MOVES)
    assert len(told[0]) >= 1
    assert len(told[0]) <= attack().count
    for later in told[1:]:
        np.testing.assert_allclose(later, told[0], atol=1e-9)


def test_a_ghost_ahead_is_in_the_path_of_the_ego(surface):
    ((box,), *_) = frames(GhostAhead(steps=1), surface, [STANDING - [0, 8, 0, 0, 0]], [np.eye(4)])
    assert 7.0 <= box[0] <= 15.0
    assert (box[1], box[4]) == (0.0, 0.0)


@pytest.mark.parametrize(("speed", "expected"), [(9.0, 9.0), (0.0, 6.0)])
def test_a_driving_ghost_keeps_the_speed_of_whom_it_follows(speed, expected, surface):
    truths = [np.array([car(-5.0 + speed * 0.2 * n, -4.0)]) for n in range(5)]
    told = np.array(frames(GhostDriving(steps=1), surface, truths, [np.eye(4)] * 5))[:, 0]
    np.testing.assert_allclose(np.diff(told[:, 0]) / 0.2, expected, atol=1e-6)
    np.testing.assert_allclose(told[:, 1], -4.0, atol=1e-9)


def test_a_driving_ghost_that_meets_somebody_begins_anew_behind_somebody_who_drives(surface):
    standing, driving = car(0.0, -5.0), [car(-8.0 + 1.6 * n, 9.0) for n in range(16)]
    truths = [np.array([standing, car(21.0, -5.0), moving]) for moving in driving]
    told = np.array(frames(GhostDriving(steps=1), surface, truths, [np.eye(4)] * 16))[:, 0]
    jumps = np.flatnonzero(np.abs(np.diff(told[:, :2], axis=0)).sum(axis=1) > 2.5)
    for jump in jumps:
        assert told[jump + 1, 1] == pytest.approx(9.0)
    for truth, box in zip(truths, told, strict=True):
        assert np.hypot(*(truth[:, :2] - box[:2]).T).min() >= 3.0


def test_a_vehicle_is_followed_where_it_can_have_driven():
    north = np.pi / 2
    others = np.array([car(3.0, 0.0), car(0.5, 2.0, north), car(0.0, 9.0)])
    seen = Followed(car(0.0, 0.0, north)).among(others, 0.2)
    np.testing.assert_array_equal(seen.box[:2], [0.5, 2.0])
    assert seen.speed == pytest.approx(10.0)
    assert seen.among(np.array([car(3.0, 4.0), car(0.5, 12.0)]), 0.2) is None
    on = seen.among(np.array([car(0.5, 2.5, north), car(0.6, 4.1, north)]), 0.2)
    assert on.box[1] == 4.1
    assert seen.among(np.empty((0, 5)), 0.2) is None


def test_a_perturbation_begins_where_the_last_one_ended(surface):
    memory, truth = {}, street(surface)
    attack = Remove(epsilon=15.0, steps=10, step_size=0.15)
    levels = []
    for number in range(6):
        met = Situation(number, truth=truth, memory=memory)
        logits, _ = strike(attack, surface, met)
        row, column = (1, 0) if met.lies[0].box[0] < 10 else (2, 2)
        levels.append(float(logits[row, column]))
    assert levels[5] < levels[0] - 5.0


@pytest.mark.parametrize("objects", [11, 0])
def test_there_are_one_to_ten_ghosts(objects):
    with pytest.raises(ValueError, match="objects"):
        Ghosts(objects=objects)


SHOWING = {"ghost": 0.6, "ghost-driving": 0.6, "ghosts": 0.6, "remove": 0.1, "dim": 0.3, "displace": 0.5, "jump": 0.6}


@pytest.mark.parametrize("name", SHOWING)
def test_the_lie_shows_in_the_undefended_fusion(name, detector):
    for met in Encounters(detector, IntersectionScene(2)).sequence(3, name, ["car-3", "rsu"]):
        boxes = met.prepare(met.ego, met.teammates).detect(met.team)
        assert met.attackers == {"car-3", "rsu"}
        assert met.lies
        for lie in met.lies:
            near = boxes[np.hypot(*(boxes[:, :2] - lie.box[:2]).T) < 1.0]
            if lie.kind in ("erased", "dimmed"):
                assert near[:, 5].max(initial=0.0) < SHOWING[name]
                assert pairwise_iou(lie.box[None], met.truth).max() > 0.99
            else:
                assert near[:, 5].max(initial=0.0) > SHOWING[name]
