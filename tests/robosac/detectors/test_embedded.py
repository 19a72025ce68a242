import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from robosac import wire
from robosac.boxes import pairwise_iou, pose_matrix
from robosac.detectors import EmbeddedDetector, Message, WeightsError, available, load
from robosac.detectors.base import check_boxes, in_precision
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.detectors.network import CHANNELS, MAP, FastDecoder, MeanFusionNetwork, fold_batchnorm
from robosac.detectors.weights_file import read_weights
from robosac.scenes.splits import TRAINING_SEEDS, VALIDATION_SEEDS


def test_the_shipped_weights_are_small_and_say_how_they_were_made():
    tensors, recipe = read_weights(SHIPPED_WEIGHTS)
    assert SHIPPED_WEIGHTS.stat().st_size <= 2_000_000
    assert all(tensor.dtype in (torch.float16, torch.int64) for tensor in tensors.values())
    assert recipe["command"].startswith("robosac train")
    first, last = recipe["data"]["training_seeds"]
    assert first in TRAINING_SEEDS
    assert last in TRAINING_SEEDS
    assert all(seed in VALIDATION_SEEDS for seed in recipe["data"]["validation_seeds"])
    assert {"seed", "feature_gain", "consensus_score", "tensors_sha256", "validation"} <= recipe.keys()


def test_the_registry_loads_it(detector):
    assert available() == ("intersection-mean",)
    assert load().info == detector.info
    with pytest.raises(ValueError, match="give one of intersection-mean"):
        load("nonesuch")


def test_what_is_only_served_needs_to_prepare_frames_and_no_more(detector, monkeypatch):
    served = SimpleNamespace(info=detector.info, prepare=detector.prepare)
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(whole=lambda: served, bare=object))
    assert load("own:whole") is served
    with pytest.raises(ValueError, match=r"own:bare made no detector but a .*, which lacks info \(Name.* prepare \(Do"):
        load("own:bare")


def test_a_message_is_what_the_detector_declares(detector, benign, ego_message):
    for role, message in (("ego", ego_message), ("teammate", benign["rsu"])):
        for name, spec in detector.info.tensors[role].items():
            assert message.tensors[name].shape == spec.shape
            assert message.tensors[name].dtype.name == spec.dtype


def test_a_folded_network_computes_the_same(rng):
    tensors, _ = read_weights(SHIPPED_WEIGHTS)
    plain, folded = MeanFusionNetwork().eval(), MeanFusionNetwork().eval()
    for network in (plain, folded):
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    fold_batchnorm(folded)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
    maps = torch.from_numpy(rng.random((1, CHANNELS, MAP, MAP))).float()
    with torch.inference_mode():
        torch.testing.assert_close(folded.decode(maps), plain.decode(maps), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("dtype", "near"), [(torch.float32, 1e-5), (torch.bfloat16, 0.1), (torch.float16, 0.02)])
def test_the_fast_decoder_computes_the_same(dtype, near, rng):
    tensors, _ = read_weights(SHIPPED_WEIGHTS)
    network = MeanFusionNetwork()
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    fold_batchnorm(network.eval()).to(dtype)
    maps = torch.from_numpy(rng.random((2, CHANNELS, MAP, MAP))).to(dtype)
    with torch.inference_mode():
        torch.testing.assert_close(FastDecoder(network).decode(maps), network.decode(maps), atol=near, rtol=near)


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_in_a_narrow_precision_it_sees_the_same(precision, detector, ego_message, benign):
    narrow = load(f"intersection-mean@{precision}")
    assert narrow.info == in_precision(detector.info, precision)
    wide_boxes, boxes = (at.prepare(ego_message, benign).detect(list(benign)) for at in (detector, narrow))
    sure = wide_boxes[wide_boxes[:, 5] >= 0.3]
    assert len(sure) > 5
    overlap = pairwise_iou(sure, boxes)
    assert (overlap.max(axis=1) > 0.8).all()
    assert 0 < np.abs(boxes[overlap.argmax(axis=1), 5] - sure[:, 5]).max() < 0.05


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "float16"])
def test_messages_of_enormous_numbers_make_sound_boxes_or_none(precision, detector, ego_message, benign, rng):
    narrow, shape = detector.in_precision(precision), benign["rsu"].tensors["features"].shape
    for largest in (300.0, 3e3, 65504.0):
        for numbers in (np.full(shape, largest), largest * rng.random(shape), largest * rng.choice([0, 1], shape)):
            hostile = Message(benign["rsu"].pose, {"features": numbers.astype(np.float16)})
            for worth in (1, 2):
                frame = narrow.on_device("cpu", worth).prepare(ego_message, {**benign, "rsu": hostile})
                for boxes in frame.detect_all([("rsu",), tuple(benign)]):
                    check_boxes(boxes)


def test_a_message_lies_in_memory_as_one_that_was_received(detector, attacked, ego_message):
    body = wire.read_frame(wire.pack_frame(0, ego_message, attacked))
    received = {name: wire.check_message(each, detector.info, "teammate") for name, each in body.teammates.items()}
    for name in ("rsu", "car-2"):  # as encoded, and as perturbed
        here, there = attacked[name].tensors["features"], received[name].tensors["features"]
        assert here.strides == there.strides
        np.testing.assert_array_equal(here, there)


def test_maps_of_any_layout_are_fused_in_one(detector, benign, ego_message):
    """The sum of maps of unlike layouts takes many times longer."""
    features = ego_message.tensors["features"]
    channels_last = np.ascontiguousarray(features.transpose(1, 2, 0)).transpose(2, 0, 1)
    for teammates in ({}, benign):
        prepared = detector.prepare(Message(ego_message.pose, {"features": channels_last}), teammates)
        assert {maps.stride() for maps in (prepared.own, *prepared.warped.values())} == {(1, 32 * 64, 64)}


def found(boxes, truth):
    confident = boxes[boxes[:, 5] >= 0.3]
    return (pairwise_iou(truth, confident).max(axis=1) >= 0.5).mean()


def test_it_sees_and_sees_more_with_teammates(detector, ego_message, benign, scene_frame):
    truth = scene_frame.truth("car-1")
    prepared = detector.prepare(ego_message, benign)
    alone, together = prepared.detect(), prepared.detect(list(benign))
    assert found(alone, truth) > 0.4
    assert found(together, truth) > 0.85
    assert found(together, truth) > found(alone, truth) + 0.1


def test_boxes_are_sorted_finite_and_not_the_ego_itself(detector, ego_message, attacked):
    boxes = detector.prepare(ego_message, attacked).detect(list(attacked))
    assert np.isfinite(boxes).all()
    assert (np.diff(boxes[:, 5]) <= 0).all()
    assert len(boxes) <= 200


def test_the_order_of_teammates_does_not_matter(detector, ego_message, benign):
    prepared = detector.prepare(ego_message, benign)
    team = list(benign)
    np.testing.assert_allclose(prepared.detect(team), prepared.detect(team[::-1]), atol=1e-3)


def test_a_subset_is_decoded_as_if_nobody_else_were_there(detector, ego_message, benign):
    some = ["car-3", "rsu"]
    full = detector.prepare(ego_message, benign).detect(some)
    only = detector.prepare(ego_message, {name: benign[name] for name in some}).detect(some)
    np.testing.assert_allclose(full, only, atol=1e-5)


def test_an_unknown_teammate_is_an_error(detector, ego_message, benign):
    with pytest.raises(KeyError):
        detector.prepare(ego_message, benign).detect(["car-9"])


def test_the_gain_changes_messages_and_nothing_else(scene_frame):
    tensors, _ = read_weights(SHIPPED_WEIGHTS)
    network = MeanFusionNetwork()
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    answers = []
    for gain in (1.0, 0.25):
        detector = EmbeddedDetector.from_network(network, gain, 0.1, 0.3)
        messages = {name: detector.encode(v.points, v.pose) for name, v in scene_frame.views.items()}
        ego = messages.pop("car-1")
        answers.append((ego.tensors["features"], detector.prepare(ego, messages).detect(list(messages))))
    (features, boxes), (weak, same_boxes) = answers
    np.testing.assert_allclose(weak * 4.0, features, rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(boxes, same_boxes, atol=1e-4)  # a power of two loses no bits


def test_the_frame_is_anchored_to_the_ego_not_to_the_world(detector, ego_message, benign):
    shift = pose_matrix(100.0, -50.0, 0.0, 1.2)

    def moved(message):
        return Message(shift @ message.pose, message.tensors)

    team = list(benign)
    here = detector.prepare(ego_message, benign).detect(team)
    there = detector.prepare(moved(ego_message), {n: moved(m) for n, m in benign.items()}).detect(team)
    np.testing.assert_allclose(here, there, atol=5e-3)


def test_the_attack_surface_agrees_with_detection(detector, ego_message, benign):
    surface = detector.attack_surface(ego_message, benign)
    logits = surface.class_logits(surface.messages)
    best = torch.sigmoid(logits).max()
    assert float(best) == pytest.approx(detector.prepare(ego_message, benign).detect(list(benign))[0, 5], abs=1e-3)
    variable = surface.messages["rsu"].clone().requires_grad_(True)
    surface.class_logits({**surface.messages, "rsu": variable}).sum().backward()
    assert variable.grad.abs().sum() > 0


def test_an_attacker_sees_the_boxes_that_are_decoded(detector, ego_message, benign):
    surface = detector.attack_surface(ego_message, benign)
    logits, geometry = surface.perceive(surface.messages)
    torch.testing.assert_close(logits, surface.class_logits(surface.messages))
    assert geometry.shape == (*logits.shape, 6)
    boxes = detector.prepare(ego_message, benign).detect(list(benign))[:10]
    for x, y, length, width, yaw, score in boxes:
        cell = (torch.sigmoid(logits) - score).abs().argmin()
        expected = [x, y, np.log(length), np.log(width), np.cos(2 * yaw), np.sin(2 * yaw)]
        shown = geometry.reshape(-1, 6)[cell].numpy()
        shown[4:] /= np.hypot(*shown[4:])
        np.testing.assert_allclose(shown, expected, atol=1e-3)


def rewritten(tmp_path, change):
    tensors = load_file(SHIPPED_WEIGHTS)
    _, recipe = read_weights(SHIPPED_WEIGHTS)
    metadata = {"robosac": json.dumps(recipe)}
    change(tensors, metadata)
    path = tmp_path / "weights.safetensors"
    save_file(tensors, path, metadata=metadata)
    return path


def flip_one_value(tensors, metadata):
    next(iter(tensors.values())).view(-1)[0] += 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (flip_one_value, "is damaged"),
        (lambda tensors, metadata: metadata.clear(), "no recipe"),
        (lambda tensors, metadata: tensors.pop("class_head.bias"), "is damaged"),
    ],
)
def test_weights_that_cannot_be_trusted_are_refused(change, message, tmp_path):
    with pytest.raises(WeightsError, match=message):
        EmbeddedDetector(rewritten(tmp_path, change))


@pytest.mark.parametrize("name", ["feature_gain", "score_threshold", "consensus_score"])
@pytest.mark.parametrize("value", [None, 0.0, -1.0, "0.3", float("nan"), float("inf"), ...])
def test_recipes_with_impossible_numbers_are_refused(name, value, tmp_path):
    def change(tensors, metadata):
        recipe = json.loads(metadata["robosac"])
        if value is ...:
            del recipe[name]
        else:
            recipe[name] = value
        metadata["robosac"] = json.dumps(recipe)

    with pytest.raises(WeightsError, match=name):
        EmbeddedDetector(rewritten(tmp_path, change))


def test_a_file_that_is_no_weights_file_is_refused(tmp_path):
    path = tmp_path / "weights.safetensors"
    with pytest.raises(WeightsError, match="is a folder; a weights file is wanted"):
        EmbeddedDetector(tmp_path)
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        EmbeddedDetector(path)
    path.write_bytes(b"junk")
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        EmbeddedDetector(path)
