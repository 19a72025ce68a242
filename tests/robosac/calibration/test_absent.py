import numpy as np

from robosac.attacks import GaussianNoise
from robosac.calibration.verdicts import Trial, collect, validation_stretches
from robosac.evaluation.benign_scores import single_teammate_indices
from robosac.scenes import IntersectionScene
from robosac.scenes.disturbances import Dropped


def scenes(share):
    return [Dropped(IntersectionScene(seed), share) for seed in range(1000, 1004)]


def test_stretches_are_collected_where_messages_get_lost(detector):
    trial = Trial({"noise": GaussianNoise()}, (1, 2))
    stretches = list(validation_stretches(detector, scenes(0.4), trial, np.random.default_rng(0)))
    assert [kind for kind, _ in stretches] == [None, "noise", "noise"] * 4
    teams = [len(frame.team) for _, stretch in stretches for frame in stretch]
    assert 0 < min(teams) < max(teams) <= 5
    attackers = [len(frame.attackers) for kind, stretch in stretches if kind for frame in stretch]
    assert set(attackers) == {0, 1, 2}  # some attackers are absent from a frame
    assert collect(stretches).pairs.total() > 0


def test_honest_teammates_are_measured_where_messages_get_lost(detector):
    assert 0 < len(single_teammate_indices(detector, scenes(0.4))) < len(single_teammate_indices(detector, scenes(0.0)))
