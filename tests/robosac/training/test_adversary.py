import numpy as np
import pytest
import torch

from robosac.detectors.network import MeanFusionNetwork
from robosac.training.adversary import AdversaryConfig, add_adversary
from robosac.training.loss import detection_loss, stack, targets

STILL = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture
def network():
    torch.manual_seed(0)
    return MeanFusionNetwork().train()


@pytest.fixture
def goal():
    near = np.array([[10.5, 0.5, 4.5, 1.9, 0.3], [-8.2, 12.0, 4.5, 1.9, 1.5]])
    return stack([targets(near, np.array([9, 9]))] * 3)


def attack(network, goal, share=1.0, seed=0, **options):
    fused = torch.rand(3, 64, 32, 32, generator=torch.Generator().manual_seed(1)).requires_grad_(True)
    matrices = [[STILL], [], [STILL, STILL, STILL]]
    config = AdversaryConfig(share=share, **options)
    return fused, add_adversary(network, fused, matrices, goal, config, np.random.default_rng(seed))


def test_the_loss_grows_within_the_bound_for_egos_with_teammates_only(network, goal):
    fused, attacked = attack(network, goal, epsilon=0.4, steps=5, step_size=0.2)
    difference = (attacked - fused).detach().abs().amax(dim=(1, 2, 3))
    assert float(difference[0]) == pytest.approx(0.4 / 2, abs=1e-5)
    assert float(difference[1]) == 0.0
    assert float(difference[2]) == pytest.approx(0.4 / 4, abs=1e-5)
    network.eval()
    with torch.no_grad():
        assert detection_loss(*network.decode(attacked), goal) > detection_loss(*network.decode(fused), goal)


def test_the_attack_leaves_the_networks_statistics_and_mode_alone(network, goal):
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    attack(network, goal)
    assert network.training
    for name, buffer in network.named_buffers():
        torch.testing.assert_close(buffer, before[name])


def test_gradients_reach_the_benign_maps(network, goal):
    fused, attacked = attack(network, goal)
    attacked.sum().backward()
    torch.testing.assert_close(fused.grad, torch.ones_like(fused))


def test_without_share_nothing_is_attacked(network, goal):
    fused, attacked = attack(network, goal, share=0.0)
    assert attacked is fused
