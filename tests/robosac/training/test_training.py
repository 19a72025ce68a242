import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open

from robosac.detectors import EmbeddedDetector
from robosac.detectors.decoding import cell_centres
from robosac.detectors.network import MeanFusionNetwork
from robosac.scenes import IntersectionScene
from robosac.training.data import TrainingFrame
from robosac.training.export import export_weights
from robosac.training.loop import TrainingConfig, _step, train_network
from robosac.training.loss import detection_loss, stack, targets
from robosac.training.validation import OperatingPoint

TINY = TrainingConfig(scenes=2, frames_per_scene=2, steps=24, frames_per_step=2, egos_per_frame=2)


def silent(stage, done, total, remark):
    assert 1 <= done <= total


class Stop(Exception):
    pass


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network, its checkpoint, and the losses on the way."""
    checkpoint, losses = tmp_path_factory.mktemp("trained") / "whole.pt", []

    def note(stage, done, total, remark):
        silent(stage, done, total, remark)
        if stage == "train":
            losses.append(float(remark.split()[-1]))

    return train_network(TINY, checkpoint, note), checkpoint, losses


def test_training_learns_and_resumes_where_it_stopped(trained, tmp_path):
    whole, _, losses = trained
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])

    def interrupt(stage, done, total, remark):
        if stage == "train" and done == 13:
            raise Stop

    with pytest.raises(Stop):
        train_network(TINY, tmp_path / "parts.pt", interrupt, checkpoint_every=8)
    steps = []
    resumed = train_network(
        TINY, tmp_path / "parts.pt", lambda stage, done, *_: steps.append(done) if stage == "train" else None
    )
    assert steps == list(range(9, 25))
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], tensor)


def test_a_checkpoint_of_another_run_is_refused(trained):
    _, checkpoint, _ = trained
    with pytest.raises(ValueError, match="another configuration"):
        train_network(replace(TINY, seed=2), checkpoint, silent)


def test_exported_weights_load_with_their_recipe(trained, tmp_path):
    network, _, _ = trained
    point = OperatingPoint(0.5, 0.1, 0.3, {"ego_only_ap50": 0.1})
    path = tmp_path / "weights.safetensors"
    recipe = export_weights(network, TINY, point, "robosac train --out DIR", path)
    detector = EmbeddedDetector(path)
    assert detector.recipe == recipe
    assert detector.info.consensus_score == 0.3
    with safe_open(path, framework="pt") as file:
        assert json.loads(file.metadata()["robosac"])["feature_gain"] == 0.5
        assert file.get_tensor("class_head.weight").dtype is torch.float16


def test_targets_know_what_was_seen_what_is_doubtful_and_what_nobody_can_know():
    near = np.array(
        [[10.5, 0.5, 4.5, 1.9, 0.3], [20.5, 0.5, 4.5, 1.9, 0.0], [-10.5, 0.5, 4.5, 1.9, 0.0], [0.5, 0.5, 4.5, 2, 0]]
    )
    heat, weight, codes, code_weight = targets(near, np.array([9, 2, 0, 50]))
    seen, doubtful, unseen, own = (32, 42), (32, 52), (32, 21), (32, 32)
    assert (heat[seen], weight[seen], code_weight[seen]) == (1.0, 1.0, 1.0)
    assert (round(heat[doubtful], 6), weight[doubtful], code_weight[doubtful]) == (0.0, 0.0, 0.0)
    assert (round(heat[unseen], 6), weight[unseen]) == (0.0, 1.0)
    assert (weight[own], code_weight[own]) == (0.0, 0.0)
    xs, ys = cell_centres()
    np.testing.assert_allclose(codes[:2, *seen], near[0, :2] - [xs[seen], ys[seen]], atol=1e-6)
    np.testing.assert_allclose(codes[2:, *seen], [np.log(4.5), np.log(1.9), np.cos(0.6), np.sin(0.6)], atol=1e-6)


def test_a_doubtful_neighbour_does_not_hide_what_was_seen():
    near = np.array([[10.5, 0.5, 4.5, 1.9, 0.0], [11.5, 0.5, 4.5, 1.9, 0.0]])
    for hits in ([9, 2], [2, 9]):
        heat, weight, _, _ = targets(near, np.array(hits))
        seen = (32, 42) if hits[0] == 9 else (32, 43)
        assert (heat[seen], weight[seen]) == (1.0, 1.0)


@pytest.mark.parametrize(("share", "others_count"), [(1.0, False), (0.0, True)])
def test_what_only_others_saw_is_background_to_an_ego_that_is_decoded_alone(share, others_count):
    frame = TrainingFrame.from_scene(IntersectionScene(0).frame(0))
    alone, unseen = [hits.copy() for hits in frame.hits], [hits.copy() for hits in frame.hits]
    for ego, (kept, lost) in enumerate(zip(alone, unseen, strict=True)):
        kept[np.arange(len(kept)) != ego] = 0
        lost[ego] = 0
    everything, own, others = (loss_of_a_step(replace(frame, hits=hits), share) for hits in (frame.hits, alone, unseen))
    assert (own != everything) == others_count
    assert others != everything


def loss_of_a_step(frame, ego_only_share):
    torch.manual_seed(0)
    network = MeanFusionNetwork()
    optimiser = torch.optim.SGD(network.parameters(), lr=0.0)
    config = replace(TINY, frames_per_step=1, egos_per_frame=6, ego_only_share=ego_only_share)
    return _step(network, optimiser, [frame], config, np.random.default_rng(0))


def test_the_loss_is_least_at_the_truth():
    goal = stack([targets(np.array([[10.5, 0.5, 4.5, 1.9, 0.3]]), np.array([9]))])
    heat, _, codes, _ = goal
    right = torch.where(heat == 1.0, 8.0, -8.0)
    assert float(detection_loss(right, codes, goal)) < 0.05
    assert float(detection_loss(-right, codes, goal)) > 1.0
    assert float(detection_loss(right, codes + 1.0, goal)) > 1.0
