import numpy as np
import pytest
import torch

from robosac.attacks import ATTACKS, PGD, inverted_pseudo_truth


class Linear:
    """An ego that adds up all messages: what an attack should do to it is known in closed form."""

    def __init__(self, shape=(3, 4)):
        generator = torch.Generator().manual_seed(0)
        self.ego = torch.randn(shape, generator=generator) * 3
        self.messages = {name: torch.randn(shape, generator=generator) * 0.1 for name in ("a", "b", "c")}

    def class_logits(self, messages):
        total = self.ego
        for message in messages.values():
            total = total + message
        return total


@pytest.fixture
def surface():
    return Linear()


attacks = pytest.mark.parametrize("attack", list(ATTACKS.values()), ids=list(ATTACKS))


@attacks
@pytest.mark.parametrize("attackers", [["a"], ["a", "c"], ["c", "b", "a"]])
def test_the_bound_holds_and_only_attackers_change(attack, attackers, surface, rng):
    clean = {name: message.clone() for name, message in surface.messages.items()}
    sent = attack(epsilon=0.3).run(surface, attackers, rng)
    assert set(sent) == set(attackers)
    for name, message in sent.items():
        assert message.shape == clean[name].shape
        assert float((message - clean[name]).abs().max()) <= 0.3 + 1e-6
        assert not message.requires_grad
    for name, message in surface.messages.items():
        torch.testing.assert_close(message, clean[name])


@attacks
def test_the_objective_falls(attack, surface, rng):
    sent = attack().run(surface, ["a", "b"], rng)
    before = inverted_pseudo_truth(surface.ego, surface.class_logits(surface.messages))
    after = inverted_pseudo_truth(surface.ego, surface.class_logits({**surface.messages, **sent}))
    assert after < before


@attacks
def test_the_same_generator_gives_the_same_attack(attack, surface):
    first, second = (attack().run(surface, ["b", "a"], np.random.default_rng(5)) for _ in range(2))
    for name in first:
        torch.testing.assert_close(first[name], second[name])


@attacks
def test_without_attackers_nothing_is_sent(attack, surface, rng):
    assert attack().run(surface, [], rng) == {}


@attacks
def test_an_attacker_that_is_not_there_is_an_error(attack, surface, rng):
    with pytest.raises(KeyError):
        attack().run(surface, ["nobody"], rng)


@attacks
@pytest.mark.parametrize("parameter", ["steps", "step_size", "epsilon"])
@pytest.mark.parametrize("value", [0, -1])
def test_parameters_must_be_positive(attack, parameter, value):
    with pytest.raises(ValueError, match=parameter):
        attack(**{parameter: value})


def test_pgd_reaches_the_corner_of_the_ball_on_a_linear_ego(surface, rng):
    sent = PGD(steps=30).run(surface, ["a"], rng)
    wanted = -surface.ego.sign() * 0.5  # against what the ego sees, wherever it is sure
    sure = surface.ego.abs() > 1.5
    torch.testing.assert_close((sent["a"] - surface.messages["a"])[sure], wanted[sure])


def test_pgd_starts_at_random_within_the_ball(surface, rng):
    start = PGD(epsilon=0.2).start(surface.messages, rng)
    values = torch.cat([d.flatten() for d in start.values()])
    assert float(values.abs().max()) <= 0.2
    assert float(values.std()) > 0.05


def test_pgd_overruns_an_undefended_ego(detector, ego_message, benign, attacked, scene_frame):
    from tests.robosac.detectors.test_embedded import found

    truth, team = scene_frame.truth("car-1"), list(benign)
    before = detector.prepare(ego_message, benign).detect(team)
    after = detector.prepare(ego_message, attacked).detect(team)
    precision_before = len(truth) / max(len(before), 1)
    precision_after = len(truth) / max(len(after), 1)
    assert found(after, truth) < found(before, truth) or precision_after < 0.5 * precision_before
    difference = attacked["car-2"].tensors["features"].astype(float) - benign["car-2"].tensors["features"].astype(float)
    assert np.abs(difference).max() <= 0.5 + 2e-3  # half floats round
