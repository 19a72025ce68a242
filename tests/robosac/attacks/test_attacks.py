import numpy as np
import pytest
import torch

from robosac.attacks import ATTACKS, BIM, PGD, CarliniWagner, Copy, Deny, Erase, GaussianNoise, IterativeAttack
from tests.robosac.attacks.linear import Linear, after_another_frame, situation


@pytest.fixture
def surface():
    linear = Linear()
    linear.bends = 0.02
    linear.messages["c"].flatten()[linear.ego.argmin()] = 12.0  # what only a teammate sees
    return linear


attacks = pytest.mark.parametrize("attack", list(ATTACKS.values()), ids=list(ATTACKS))


@attacks
@pytest.mark.parametrize("attackers", [["a"], ["a", "c"], ["c", "b", "a"]])
def test_the_bound_holds_and_only_attackers_change(attack, attackers, surface, rng):
    clean = {name: message.clone() for name, message in surface.messages.items()}
    made = attack(epsilon=0.3)
    sent = made.run(surface, attackers, rng, after_another_frame(made, surface, attackers))
    if attack not in (Copy, Deny) or len(attackers) < 3:  # with nobody else there is nobody to copy, or to deny
        assert set(sent) == set(attackers)
    for name, message in sent.items():
        assert message.shape == clean[name].shape
        assert not attack.bounded or float((message - clean[name]).abs().max()) <= 0.3 + 1e-6
        assert (message - clean[name]).abs().max() > 0.01
        assert not message.requires_grad
    for name, message in surface.messages.items():
        torch.testing.assert_close(message, clean[name])


iterative = [attack for attack in ATTACKS.values() if issubclass(attack, IterativeAttack) and attack.bounded]


def reached(attack, surface, sent, met):
    """What an attack's aim makes of these messages in a situation that it has met."""
    delta = {name: message - surface.messages[name] for name, message in sent.items()}
    return float(attack.aim(surface, list(sent), met)(sent, delta))


@pytest.mark.parametrize("attack", iterative, ids=lambda attack: attack.name)
def test_the_aim_falls(attack, surface, rng):
    untouched = {name: surface.messages[name] for name in ("a", "b")}
    met = situation(surface)
    sent = attack().run(surface, ["a", "b"], rng, met)
    assert reached(attack(), surface, sent, met) < reached(attack(), surface, untouched, met)


@pytest.mark.parametrize("attack", iterative, ids=lambda attack: attack.name)
def test_more_steps_get_further(attack, surface):
    def after(steps):
        met = situation(surface)
        sent = attack(steps=steps, step_size=0.02).run(surface, ["a"], np.random.default_rng(0), met)
        return reached(attack(), surface, sent, met)

    assert after(30) < after(1)


@attacks
def test_the_same_generator_gives_the_same_attack(attack, surface):
    def sent():
        met = after_another_frame(attack(), surface, ["b", "a"])
        return attack().run(surface, ["b", "a"], np.random.default_rng(5), met)

    first, second = sent(), sent()
    assert len(first) == 2
    for name in first:
        torch.testing.assert_close(first[name], second[name])


@attacks
def test_without_attackers_nothing_is_sent(attack, surface, rng):
    assert attack().run(surface, [], rng, situation(surface)) == {}


@attacks
def test_an_attacker_that_is_not_there_is_an_error(attack, surface, rng):
    with pytest.raises(KeyError):
        attack().run(surface, ["nobody"], rng, situation(surface))


@attacks
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_parameters_must_be_positive(attack, value):
    for parameter in vars(attack()):
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


def test_bim_starts_from_the_benign_message(surface, rng):
    assert all(not d.any() for d in BIM().start(surface.messages, rng).values())


def test_noise_fills_the_ball_and_follows_no_gradient(surface, rng):
    sent = GaussianNoise(epsilon=0.2).run(surface, ["a", "b"], rng)
    noise = torch.cat([(sent[name] - surface.messages[name]).flatten() for name in ("a", "b")])
    assert 0.08 < float(noise.abs().mean()) <= 0.2
    assert abs(float(noise.mean())) < 0.1


def test_carlini_wagner_flips_what_it_can_and_spends_no_more_than_it_needs(rng):
    surface = Linear()
    surface.ego = surface.ego.clamp(-0.4, 0.4)
    sent = CarliniWagner(epsilon=1.0, steps=200, confidence=0.1, trade_off=100.0).run(surface, ["a"], rng)
    logits = surface.class_logits({**surface.messages, **sent})
    sure = surface.ego.abs() > 0.05
    margin = torch.where(surface.ego >= 0, logits, -logits)[sure]
    assert float(margin.max()) < 0.0
    assert float((sent["a"] - surface.messages["a"]).abs().mean()) < 0.8


def test_an_eraser_leaves_what_the_ego_sees_and_erases_the_rest():
    surface = Linear()
    surface.ego = torch.full((3, 4), -4.0)
    surface.ego[0] = 4.0  # the ego sees the first row, its teammates the second
    surface.messages["b"] = torch.zeros(3, 4)
    surface.messages["b"][1] = 6.0
    sent = Erase(epsilon=5.0, steps=80).run(surface, ["a"], np.random.default_rng(0))
    logits = surface.class_logits({**surface.messages, **sent})
    assert float(logits[0].min()) > 3.0
    assert float(logits[1].max()) < -2.0


def test_an_eraser_passes_the_consensus_test(detector, ego_message, benign, scene_frame):
    from robosac.consensus import compare
    from tests.robosac.detectors.test_embedded import found

    surface = detector.attack_surface(ego_message, benign)
    erased = Erase().run(surface, ["car-2"], np.random.default_rng(0))
    received = {**benign, "car-2": detector.perturbed(benign["car-2"], erased["car-2"])}
    score, team = detector.info.consensus_score, list(benign)

    def confident(boxes):
        return boxes[boxes[:, 5] >= score]

    ego_only = confident(detector.prepare(ego_message, {}).detect())
    honest = confident(detector.prepare(ego_message, benign).detect(team))
    attacked = confident(detector.prepare(ego_message, received).detect(team))
    assert compare(ego_only, attacked).jaccard_index > compare(ego_only, honest).jaccard_index
    truth = scene_frame.truth("car-1")
    assert found(attacked, truth) < found(honest, truth) - 0.1


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
