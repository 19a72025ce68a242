from dataclasses import dataclass

import numpy as np
import pytest
import torch

from robosac.attacks import (
    PGD,
    Attack,
    AttackError,
    Campaign,
    GaussianNoise,
    IterativeAttack,
    Lie,
    OnObjects,
    load_campaign,
)
from robosac.attacks.returned import check_returned
from robosac.detectors import DetectorError, Message
from robosac.scenes import IntersectionScene
from tests.robosac.attacks.linear import Linear

SHAPE = (3, 4)


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (None, "mine: run must return a mapping of attackers to tensors, got a NoneType"),
        ([torch.zeros(SHAPE)], "mine: run must return a mapping of attackers to tensors, got a list"),
        ({"d": torch.zeros(SHAPE)}, "mine: run returned a message of 'd'; the attackers are a, b"),
        ({"c": torch.zeros(SHAPE)}, "mine: run returned a message of 'c'; the attackers are a, b"),
        ({"b": np.zeros(SHAPE)}, "mine: the message of 'b' that run returned must be a tensor, got a ndarray"),
        ({"b": torch.zeros(1, 4)}, r"the message of 'b' .* must be of shape \(3, 4\), got \(1, 4\)"),
        ({"b": torch.zeros(SHAPE, dtype=torch.complex64)}, "must be of real numbers, got torch.complex64"),
        (
            {"b": torch.zeros(SHAPE, dtype=torch.bfloat16)},
            "must be dense, of a type that numpy has, got torch.bfloat16",
        ),
        ({"b": torch.zeros(SHAPE).to_sparse()}, "must be dense, of a type that numpy has, .* torch.sparse_coo"),
        ({"b": torch.full(SHAPE, torch.nan)}, "the message of 'b' that run returned holds NaN or infinity"),
    ],
)
def test_what_is_no_message_of_an_attacker_is_refused(sent, words):
    with pytest.raises(AttackError, match=words):
        check_returned("mine", sent, Linear(), ["a", "b"])


def test_messages_of_some_attackers_will_do():
    for sent in ({}, {"a": torch.zeros(SHAPE)}, {"b": torch.zeros(SHAPE, dtype=torch.float64)}):
        check_returned("mine", sent, Linear(), ["a", "b"])


BOX = np.array([5.0, 0.0, 4.5, 1.9, 0.0])


@pytest.mark.parametrize(
    ("more", "lie", "words"),
    [
        (1e30, None, "the message of 'car-2' that run returned holds numbers too large for the tensor 'features'"),
        (0.0, "ghost", "situation.lies must hold each a Lie, got 'ghost'"),
        (0.0, Lie("moved", BOX), "a lie of kind 'moved' needs the true box of its vehicle"),
    ],
)
def test_what_a_message_cannot_hold_and_lies_that_are_none_are_refused(
    more, lie, words, detector, ego_message, benign, rng
):
    class Mine(Attack):
        name = "mine"

        def run(self, surface, attackers, rng, situation=None):
            situation.lies.extend([] if lie is None else [lie])
            return {name: surface.messages[name].double() + more for name in attackers}

    with pytest.raises(AttackError, match=f"^mine: {words}"):
        Campaign.of(Mine()).messages(detector, ego_message, benign, ["car-2"], 0, rng)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda logits: None, "got a NoneType"),
        (lambda logits: 1.0, "got a float"),
        (lambda logits: logits, r"got a tensor of shape \(3, 4\)"),
        (lambda logits: torch.tensor(1.0), "got a number that does not depend on them"),
        (lambda logits: logits.sum() * np.nan, "got NaN"),
    ],
)
def test_an_aim_that_cannot_be_descended_is_told(value, words):
    @dataclass(frozen=True)
    class Mine(IterativeAttack):
        name = "mine"

        def objective(self, known, logits, delta):
            return value(logits)

    with pytest.raises(AttackError, match=f"^mine: what is minimised must be one number .* {words}$"):
        Mine().run(Linear(), ["a"], np.random.default_rng(0))


@pytest.mark.parametrize("said", [None, "yes"])
def test_an_attack_says_whether_it_attacks(said):
    class Mine(PGD):
        name = "mine"

        def prepare(self, surface, attackers, rng, situation):
            return said

    with pytest.raises(AttackError, match=f"^mine: prepare must return True or False, got {said!r}$"):
        Mine().run(Linear(), ["a"], np.random.default_rng(0))


class Nothing(Attack):
    """Forgets to return anything."""

    name = "nothing"

    def run(self, surface, attackers, rng, situation=None):
        """Nothing is returned."""


def test_a_campaign_looks_at_what_its_attack_returns(detector):
    messages = {
        name: detector.encode(view.points, view.pose) for name, view in IntersectionScene(seed=8).frame(0).views.items()
    }
    ego = messages.pop("car-1")
    with pytest.raises(AttackError, match="nothing: run must return a mapping"):
        Campaign(Nothing()).messages(detector, ego, messages, ["rsu"], 0, np.random.default_rng(0))


def in_torch(message):
    return Message(message.pose, {name: torch.from_numpy(array) for name, array in message.tensors.items()})


class Perturbing:
    """A detector that makes something else of an attacker's tensor."""

    def __init__(self, detector, make):
        self._detector, self._make = detector, make

    def perturbed(self, message, tensor):
        return self._make(self._detector.perturbed(message, tensor))

    def __getattr__(self, name):
        return getattr(self._detector, name)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda _: None, "a Message, got a NoneType"),
        (lambda message: message.tensors["features"], "a Message, got a ndarray"),
        (in_torch, "numpy arrays; features is a Tensor"),
        (lambda message: Message(message.pose, {}), r"a message with features of .*, got none"),
        (
            lambda message: Message(message.pose, {"features": message.tensors["features"].astype("f8")}),
            r"a message with features of float16 .*, got features of float64 .*",
        ),
    ],
)
def test_what_a_detector_makes_of_an_attack_has_to_be_what_it_declares(detector, ego_message, benign, make, words):
    campaign, rng = Campaign(GaussianNoise()), np.random.default_rng(0)
    with pytest.raises(DetectorError, match=f"^{detector.info.name}: perturbed must return {words}$"):
        campaign.messages(Perturbing(detector, make), ego_message, benign, ["rsu"], 0, rng)


def test_needs_are_a_tuple_of_names():
    class Needs(Nothing):
        needs = "class_logits"

    with pytest.raises(ValueError, match=r"needs must be a tuple of names, such as \('class_logits',\)"):
        Needs()


def test_an_attack_has_a_name():
    @dataclass(frozen=True)
    class Nameless(PGD):
        name = None

    with pytest.raises(ValueError, match=r"^Nameless has no name: give the class a text, such as name = 'mine'$"):
        Campaign(Nameless())


@pytest.mark.parametrize("attack", ["pgd", "noise", "frozen"])
def test_an_attacker_that_sends_nothing_is_named(attack):
    chosen = load_campaign(attack).attack
    with pytest.raises(KeyError) as refused:
        chosen.run(Linear(), ["a", "car-9"], np.random.default_rng(0))
    assert str(refused.value) == "the attacker 'car-9' sends nothing in this frame; a, b, c do"
    assert isinstance(refused.value, AttackError)
    with pytest.raises(TypeError, match="attackers must be a collection of names, got the text 'car-2'"):
        chosen.run(Linear(), "car-2", np.random.default_rng(0))


def test_a_seed_is_no_generator():
    with pytest.raises(TypeError, match=r"rng must be a numpy\.random\.Generator, got 0"):
        PGD().run(Linear(), ["a"], 0)


BOX = np.array([10.0, 5.0, 4.6, 1.9, 0.0])


@pytest.mark.parametrize(
    ("lie", "words"),
    [
        (("swap", BOX), "no lie is of kind 'swap'; the kinds are ghost, erased, dimmed, moved, reshaped"),
        (("ghost", BOX[:4]), r"^box of a lie must be x, y, length, width, yaw, .* got one of shape \(4,\)"),
        (("ghost", BOX.tolist()), r"^box of a lie must be .*, got \[10.0"),
        (("ghost", BOX * [1, 1, -1, 1, 1]), "finite, length and width positive, got"),
        (("ghost", BOX * np.nan), "finite, length and width positive, got"),
        (("ghost", BOX, [1]), r"the number of a lie must be an integer, got \[1\]"),
        (("moved", BOX, 0, BOX[None]), r"^truth of a lie must be .* got one of shape \(1, 5\)"),
    ],
)
def test_a_lie_is_about_an_object_that_can_be(lie, words):
    with pytest.raises(ValueError, match=words):
        Lie(*lie)


@pytest.mark.parametrize("told", [None, Lie("ghost", BOX), [BOX]])
def test_lies_are_a_list_of_them(told):
    class Mine(OnObjects):
        name = "mine"

        def lies(self, scope, rng):
            return told

    with pytest.raises(AttackError, match="mine: lies must return a list of Lie, got "):
        Mine().run(Linear(), ["a"], np.random.default_rng(0))
