import numpy as np
import pytest
import torch

from robosac.attacks import PGD, Campaign, Past, Situation, load_campaign, penalties
from robosac.attacks.campaign import asleep
from robosac.boxes import pose_matrix
from robosac.consensus import at_least
from robosac.defenses.group_testing.geometry import changes, followed, measure
from tests.robosac.attacks.linear import Linear


class Apart(Linear):
    """Places in a row, 10 m apart, whose boxes nothing moves."""

    def __init__(self):
        super().__init__((1, 6))
        self.ego = torch.full((1, 6), -8.0)
        self.ego[0, 0] = self.ego[0, 1] = 5.0
        self.messages = {name: torch.zeros(1, 6) for name in "abc"}

    def perceive(self, messages):
        logits, boxes = super().perceive(messages)
        fixed = boxes.clone()
        fixed[..., 1] = 0.0
        return logits, fixed


def sent(*changed):
    tensor = torch.zeros(1, 6)
    for column, value in changed:
        tensor[0, column] = value
    return {"a": tensor.requires_grad_(True)}


def test_honest_messages_pay_nothing_in_pairs():
    surface = Apart()
    assert float(penalties.pairs(Situation(), surface, {"a": surface.messages["a"]})) == pytest.approx(0.0, abs=1e-6)


def test_what_is_lost_and_what_is_new_is_paid_for():
    surface = Apart()
    paid = {}
    for what, change in (("lost", (0, -12.0)), ("new", (4, 14.0)), ("kept", (1, 1.0))):
        message = sent(change)
        penalty = penalties.pairs(Situation(), surface, message)
        paid[what] = penalty.item()
        (gradient,) = torch.autograd.grad(penalty, message["a"])
        assert torch.isfinite(gradient).all()
    assert paid["kept"] < 0.05 < paid["new"]
    assert paid["lost"] > 0.3


def shown_before(surface, message, pose=None):
    memory = {}
    penalties.remember(Situation(memory=memory, ego_pose=np.eye(4) if pose is None else pose), surface, message)
    return memory


def test_what_comes_and_goes_is_paid_for():
    surface = Apart()
    assert penalties.changes(Situation(), surface, sent()).item() == 0.0  # there was no frame before
    memory = shown_before(surface, sent((3, 14.0)))
    still, gone, come = (
        penalties.changes(Situation(1, memory=memory), surface, message).item()
        for message in (sent((3, 14.0)), sent(), sent((3, 14.0), (5, 14.0)))
    )
    assert still < 0.1
    assert gone > still + 0.5
    assert come > still + 0.5


def test_what_stands_in_the_world_may_move_for_the_ego():
    surface = Apart()
    memory = shown_before(surface, sent(), pose_matrix(0.0, 2.0, 1.7, 0.0))
    assert penalties.changes(Situation(1, memory=memory), surface, sent()).item() > 0.5  # 2 m across is a jump
    memory = shown_before(surface, sent(), pose_matrix(1.0, 0.0, 1.7, 0.0))
    assert penalties.changes(Situation(1, memory=memory), surface, sent()).item() < 0.2


def test_peaks_are_boxes_that_do_not_overlap():
    logits = torch.tensor([2.0, 3.0, -4.0, 1.0])
    places = torch.tensor(
        [[0, 0, 1.4, 0.7, 1, 0], [0.5, 0, 1.4, 0.7, 1, 0], [9, 0, 1.4, 0.7, 1, 0], [9, 9, 1.4, 0.7, -1, 0]]
    )
    found = penalties.peaks(logits, places.float())
    np.testing.assert_allclose(found[:, :2], [[0.5, 0.0], [9.0, 9.0]], atol=1e-6)
    np.testing.assert_allclose(
        found[:, 2:5], [[np.exp(1.4), np.exp(0.7), 0], [np.exp(1.4), np.exp(0.7), np.pi / 2]], atol=1e-5
    )


def figures(detector, frames):
    """Means of g and v beside the ego alone, and of changes, that an attacker shows."""
    losses, news, changed, before = [], [], [], None
    for met in frames:
        prepared = met.prepare(met.ego, met.teammates)
        found = prepared.detect(["car-3"])
        pair = measure(at_least(prepared.detect(()), detector.info.consensus_score), found)
        losses.append(pair.loss)
        news.append(pair.novelty)
        now = followed(found, met.ego.pose)
        changed += [] if before is None else [changes(before, now)]
        before = now
    return np.mean(losses), np.mean(news), np.mean(changed)


@pytest.mark.parametrize("name", ["shift", "erase"])
def test_a_soft_attack_shows_less_in_what_is_measured(name, detector, played):
    hard, soft = (figures(detector, played(spec, 2)) for spec in (name, f"{name}@soft3"))
    assert soft[0] < hard[0]
    assert soft[1] < hard[1] - 2
    assert soft[2] < 0.4 * hard[2]


def test_the_list_of_penalties_is_what_is_paid(detector, messages):
    asked = []

    def costly(situation, surface, sent):
        asked.append((situation.frame, sorted(sent)))
        return sum(tensor.abs().sum() for tensor in sent.values()) * 1e3

    ego, benign = messages["car-1"], {name: messages[name] for name in ("car-2", "rsu")}
    campaign = Campaign(PGD(steps=30, step_size=0.04), softness=1.0)

    def strength():
        made = campaign.messages(detector, ego, benign, ["rsu"], 3, np.random.default_rng(0))
        return np.abs(made["rsu"].tensors["features"].astype(np.float64)).mean()

    free = strength()
    penalties.PENALTIES.append(costly)
    try:
        paid = strength()
    finally:
        penalties.PENALTIES.remove(costly)
    assert asked == [(3, ["rsu"])] * 30
    assert paid < free


def test_twice_the_bound(detector, messages):
    ego, benign = messages["car-1"], {name: messages[name] for name in ("car-2", "rsu")}
    campaign = load_campaign("bim@double@asleep")
    assert (campaign.epsilon, campaign.schedule) == (1.0, asleep)
    made = campaign.messages(detector, ego, benign, ["rsu"], 10, np.random.default_rng(0))
    change = made["rsu"].tensors["features"].astype(np.float64) - benign["rsu"].tensors["features"]
    assert 0.9 < np.abs(change).max() < 1.01


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("noise@soft", "can be soft, not noise"),
        ("honest@double", "with a bound can have another one, not honest"),
        ("copy@double", "with a bound can have another one, not copy unless it has an alibi or is soft"),
    ],
)
def test_who_cannot_be_soft_or_stronger_is_told(spec, complaint):
    with pytest.raises(ValueError, match=complaint):
        load_campaign(spec)


def test_a_soft_attack_remembers():
    assert load_campaign("shift@soft").remembers
    assert not load_campaign("shift@double").remembers
    assert load_campaign("ghost").remembers
    assert Past().earlier == {}
