import numpy as np
import pytest
import torch

from robosac.attacks import Erase, EraseStill, Invent, InventSteady, InventStill, NoGeometry, Shift, ShiftStill
from robosac.attacks.adaptive import SPACING_M
from robosac.boxes import pairwise_iou
from robosac.consensus import at_least, compare
from robosac.defenses.group_testing.geometry import changes, followed
from robosac.detectors import GeometricSurface
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene
from tests.robosac.attacks.linear import Linear


@pytest.fixture(scope="module")
def fused(request):
    """Boxes of subsets with car-2 attacking, by attack; the honest message under the attack None."""
    detector = request.getfixturevalue("detector")
    benign = encode_all(detector, FRAME)
    ego = benign.pop("car-1")
    surface = detector.attack_surface(ego, benign)
    frames = {}

    def detect(attack, team):
        if attack not in frames:
            received = dict(benign)
            if attack is not None:
                sent = attack().run(surface, ["car-2"], np.random.default_rng(0))
                received["car-2"] = detector.perturbed(benign["car-2"], sent["car-2"])
            frames[attack] = detector.prepare(ego, received)
        return at_least(frames[attack].detect(team), detector.info.consensus_score)

    return detect


FRAME = IntersectionScene(8).frame(0)  # the ego sees 18 of 28 boxes
TEAM = ["car-2", "car-3", "car-4", "car-5", "rsu"]


def precision_and_recall(boxes, truth, iou=0.7):
    hits = pairwise_iou(boxes, truth) >= iou
    return hits.any(axis=1).mean(), hits.any(axis=0).mean()


def shaken(fused, attack):
    """Mean of one minus the best overlap of what the ego sees, between the honest fusion and the attacked one."""
    before, ego = fused(None, TEAM[1:]), fused(None, [])
    before = before[pairwise_iou(before, ego).max(axis=1) > 0.5]
    return 1 - pairwise_iou(before, fused(attack, TEAM)).max(axis=1).mean()


@pytest.mark.parametrize(
    "attack", [Erase, EraseStill, Invent, InventStill, InventSteady, Shift, ShiftStill], ids=lambda a: a.name
)
def test_they_pass_the_consensus_test_and_do_harm(attack, fused):
    assert compare(fused(None, []), fused(attack, TEAM)).jaccard_index > 0.35
    truth = FRAME.truth("car-1")
    before = precision_and_recall(fused(None, TEAM), truth)
    after = precision_and_recall(fused(attack, TEAM), truth)
    assert min(a - b for a, b in zip(after, before, strict=True)) < -0.1


def test_an_inventor_adds_boxes_where_nobody_sees_any(fused):
    invented = fused(Invent, TEAM)
    new = invented[pairwise_iou(invented, fused(None, TEAM)).max(axis=1) < 0.1]
    assert len(new) >= 4
    assert (pairwise_iou(new, FRAME.truth("car-1")).max(axis=1) < 0.3).all()
    own = fused(None, [])
    assert compare(own, invented).matched >= compare(own, fused(None, TEAM)).matched - 1


def test_a_steady_inventor_puts_cars_on_a_grid(fused):
    def on_grid(attack):
        boxes = fused(attack, TEAM)
        new = boxes[pairwise_iou(boxes, fused(None, TEAM)).max(axis=1) < 0.1]
        off = np.abs(new[:, :2] - SPACING_M * np.round(new[:, :2] / SPACING_M)).max(axis=1)
        return int((off < 0.5).sum())

    assert on_grid(InventSteady) >= 3
    assert on_grid(Invent) <= 1


def test_what_a_steady_inventor_invents_is_still_there_in_the_next_frame(detector):
    def changed(attack):
        shown = []
        for frame in map(IntersectionScene(8).frame, range(2)):
            benign = encode_all(detector, frame)
            ego = benign.pop("car-1")
            surface = detector.attack_surface(ego, benign)
            sent = attack().run(surface, ["car-2"], np.random.default_rng(0))
            received = {**benign, "car-2": detector.perturbed(benign["car-2"], sent["car-2"])}
            shown.append(followed(detector.prepare(ego, received).detect(["car-2"]), ego.pose))
        return changes(*shown)

    assert changed(InventSteady) < 0.7 * changed(Invent)


def test_without_anything_seen_a_steady_inventor_has_the_whole_grid():
    surface = Linear((4, 5))
    surface.ego = torch.full((4, 5), -5.0)
    surface.messages = {name: torch.zeros(4, 5) for name in "ab"}
    sent = InventSteady(epsilon=20.0, steps=150, step_size=0.2, objects=3).run(surface, ["a"], np.random.default_rng(0))
    logits = surface.class_logits({**surface.messages, **sent})
    assert 3 <= int((logits > 0).sum()) <= 4  # a logit moves the next cell's box too


def test_a_shifter_moves_boxes_by_less_than_a_metre(fused):
    before, after, ego = fused(None, TEAM), fused(Shift, TEAM), fused(None, [])
    others = before[pairwise_iou(before, ego).max(axis=1) < 0.1]
    distance = np.hypot(*(others[:, None, :2] - after[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert len(others) >= 5
    assert 0.4 < np.median(distance) < 1.0
    assert abs(len(after) - len(before)) <= 4


@pytest.mark.parametrize(("still", "plain"), [(EraseStill, Erase), (InventStill, Invent), (ShiftStill, Shift)])
def test_holding_still_keeps_the_other_boxes_in_place(still, plain, fused):
    assert shaken(fused, still) < 0.9 * shaken(fused, plain)


def test_an_inventor_chooses_places_apart_from_all_that_is_seen():
    surface = Linear((4, 5))
    surface.ego = torch.full((4, 5), -5.0)
    surface.ego[0, 0] = 5.0
    surface.messages = {name: torch.zeros(4, 5) for name in "ab"}
    surface.messages["b"][3, 4] = 10.0  # seen by a teammate
    sent = Invent(epsilon=20.0, steps=150, step_size=0.2, objects=6).run(surface, ["a"], np.random.default_rng(0))
    logits = surface.class_logits({**surface.messages, **sent})
    seen = torch.zeros(4, 5, dtype=torch.bool)
    seen[0, 0] = seen[3, 4] = True
    assert (logits[seen] > 4).all()
    assert int((logits[~seen] > 0).sum()) == 6


def test_places_less_than_five_metres_from_one_another_are_not_both_chosen():
    class Dense(Linear):
        """Cells are 2.5 m apart."""

        def perceive(self, messages):
            logits, boxes = super().perceive(messages)
            return logits, boxes / 4

    surface = Dense((1, 8))
    surface.ego = torch.full((1, 8), -5.0)
    surface.messages = {"a": torch.zeros(1, 8)}
    sent = Invent(epsilon=20.0, steps=150, step_size=0.2).run(surface, ["a"], np.random.default_rng(0))
    assert int((surface.class_logits(sent) > 0).sum()) == 4


def test_without_boxes_to_look_at_they_say_what_is_missing(rng):
    class Scores:
        messages = Linear().messages
        class_logits = Linear().class_logits

    assert isinstance(Linear(), GeometricSurface)
    assert not isinstance(Scores(), GeometricSurface)
    Erase().run(Scores(), ["a"], rng)
    with pytest.raises(NoGeometry, match="perceive"):
        Shift().run(Scores(), ["a"], rng)
