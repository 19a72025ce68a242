import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import robosac
from robosac.attacks import PGD
from robosac.boxes import from_world, pairwise_iou, pose_matrix
from robosac.detectors import EmbeddedDetector, Message, V2XSimDetector, WeightsError, available, load
from robosac.detectors.base import for_role
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.detectors.v2xsim import write_weights
from robosac.detectors.v2xsim.detector import FUSIONS
from robosac.detectors.warp import sampling_matrix, warp
from robosac.detectors.weights_file import read_weights, tensors_digest
from robosac.wire import WireError, check_message, pack_message, read_message


@pytest.fixture(scope="module")
def frame(v2xsim, scans):
    """The messages of four vehicles; car-1 is the ego."""
    return {name: v2xsim.encode(points, pose) for name, (points, pose) in scans.items()}


@pytest.fixture(scope="module")
def ego(frame):
    return frame["car-1"]


@pytest.fixture(scope="module")
def others(v2xsim, frame):
    return {name: for_role(m, v2xsim.info, "teammate") for name, m in frame.items() if name != "car-1"}


def rewritten(tmp_path, weights, change):
    """The weights file with its tensors and recipe changed, and a digest that agrees with them."""
    tensors, (_, recipe) = load_file(weights), read_weights(weights)
    change(tensors, recipe)
    recipe["tensors_sha256"] = tensors_digest(tensors)
    path = tmp_path / "changed.safetensors"
    save_file(tensors, path, metadata={"robosac": json.dumps(recipe)})
    return path


@pytest.fixture(scope="module")
def sharp(weights, tmp_path_factory) -> V2XSimDetector:
    """The made-up weights with a bias that makes the best anchors detections."""

    def change(tensors, recipe):
        tensors["classification.conv2.bias"] += torch.tensor([-0.7, 0.7] * 6)

    return V2XSimDetector(rewritten(tmp_path_factory.mktemp("sharp"), weights, change))


def test_a_message_is_what_the_detector_declares(v2xsim, ego, others):
    assert set(ego.tensors) == {"features", "grid"}
    assert set(others["car-2"].tensors) == {"features"}
    for role, message in (("ego", ego), ("teammate", others["car-2"])):
        for name, spec in v2xsim.info.tensors[role].items():
            assert message.tensors[name].shape == spec.shape
            assert message.tensors[name].dtype.name == spec.dtype
    assert v2xsim.info.tensors["ego"]["grid"].nbytes == 256 * 256 * 13 // 8


def test_a_message_is_in_c_order(frame):
    assert all(tensor.flags.c_contiguous for message in frame.values() for tensor in message.tensors.values())


def test_messages_survive_the_wire(v2xsim, ego, others):
    for role, message in (("ego", ego), ("teammate", others["car-2"])):
        envelope = read_message(pack_message(3, "car", message))
        received = check_message(envelope.payload, v2xsim.info, role)
        np.testing.assert_array_equal(received.pose, message.pose)
        for name, array in message.tensors.items():
            np.testing.assert_array_equal(received.tensors[name], array)
    with pytest.raises(WireError, match="grid"):
        check_message(read_message(pack_message(3, "car", ego)).payload, v2xsim.info, "teammate")


def test_received_messages_can_be_fused(sharp, ego, others):
    """Arrays from the wire are read-only."""

    def received(message, role):
        return check_message(read_message(pack_message(0, "x", message)).payload, sharp.info, role)

    sent = sharp.prepare(ego, others).detect(["car-2"])
    remote = {name: received(message, "teammate") for name, message in others.items()}
    np.testing.assert_array_equal(sharp.prepare(received(ego, "ego"), remote).detect(["car-2"]), sent)


def test_boxes_are_confident_sorted_and_apart(sharp, ego, others):
    boxes = sharp.prepare(ego, others).detect(list(others))
    assert len(boxes) > 5
    assert (boxes[:, 5] > 0.7).all()
    assert (np.diff(boxes[:, 5]) <= 0).all()
    assert np.triu(pairwise_iou(boxes, boxes), 1).max() <= 0.01


def test_teammates_change_what_is_seen_and_others_do_not(sharp, ego, others):
    prepared = sharp.prepare(ego, others)
    alone, some = prepared.detect(), prepared.detect(["car-3", "car-4"])
    np.testing.assert_array_equal(alone, sharp.prepare(ego, {}).detect())
    fewer = sharp.prepare(ego, {n: others[n] for n in ("car-3", "car-4")})
    np.testing.assert_allclose(some, fewer.detect(["car-3", "car-4"]), atol=1e-4)
    swapped = fewer.detect(["car-4", "car-3"])  # its sums are rounded otherwise, so a close call may end otherwise
    assert len({tuple(box) for box in some.round(2)} & {tuple(box) for box in swapped.round(2)}) > 0.9 * len(some)
    assert alone.shape != some.shape or not np.allclose(alone, some, atol=1e-2)
    with pytest.raises(KeyError):
        prepared.detect(["car-9"])


def test_the_frame_is_anchored_to_the_ego_not_to_the_world(sharp, ego, others):
    shift = pose_matrix(100.0, -50.0, 0.0, 1.2)
    moved = {name: Message(shift @ message.pose, message.tensors) for name, message in others.items()}
    here = sharp.prepare(ego, others).detect(list(others))
    there = sharp.prepare(Message(shift @ ego.pose, ego.tensors), moved).detect(list(others))
    np.testing.assert_allclose(here, there, atol=5e-3)


def test_a_thing_lands_where_the_ego_has_it():
    """Rows run along +y, columns along -x."""
    axis = -32 + 2.0 * (np.arange(32) + 0.5)
    ys, xs = np.meshgrid(axis, -axis, indexing="ij")
    here, there = pose_matrix(3.0, -8.0, 1.7, 0.7), pose_matrix(-6.0, 2.0, 5.0, -2.1)
    thing = np.array([[1.0, 4.0, 1.0, 1.0, 0.0]])
    seen, expected = from_world(thing, there)[0], from_world(thing, here)[0]
    bump = torch.from_numpy(np.exp(-((xs - seen[0]) ** 2 + (ys - seen[1]) ** 2) / 18.0))[None, None]
    moved = warp(bump, torch.from_numpy(sampling_matrix(here, there, 32.0, mirrored=True))[None])[0, 0].numpy()
    centre = [(moved * xs).sum() / moved.sum(), (moved * ys).sum() / moved.sum()]
    np.testing.assert_allclose(centre, expected[:2], atol=0.15)


def test_a_defence_runs_on_it(sharp, ego, others):
    result = robosac.fuse(sharp, robosac.SampleConsensus(collaborators=2), ego, others, rng=np.random.default_rng(0))
    assert result.fault is None
    assert result.sampling_steps >= 1
    assert set(result.accepted) | set(result.rejected) == set(others)
    np.testing.assert_array_equal(result.boxes, sharp.prepare(ego, others).detect(result.accepted))


def test_an_attacker_of_the_message_moves_the_logits(sharp, ego, others):
    surface = sharp.attack_surface(ego, others)
    with torch.no_grad():
        benign = surface.class_logits(surface.messages)
        alone = surface.class_logits({})
    assert float(torch.sigmoid(benign).max()) == pytest.approx(
        sharp.prepare(ego, others).detect(list(others))[0, 5], abs=1e-6
    )
    tensors = PGD(steps=2).run(surface, ["car-2"], np.random.default_rng(0))
    sent = {**others, "car-2": sharp.perturbed(others["car-2"], tensors["car-2"])}
    difference = np.abs(sent["car-2"].tensors["features"] - others["car-2"].tensors["features"])
    assert 0 < difference.max() <= 0.5 + 1e-5
    with torch.no_grad():
        attacked = sharp.attack_surface(ego, sent)
        logits = attacked.class_logits(attacked.messages)
    goal = 1 - torch.sigmoid(alone)
    loss = torch.nn.functional.binary_cross_entropy_with_logits
    assert loss(logits, goal) < loss(benign, goal)


def test_an_attacker_sees_the_boxes_that_are_decoded(sharp, ego, others):
    surface = sharp.attack_surface(ego, others)
    variable = surface.messages["car-2"].clone().requires_grad_(True)
    logits, geometry = surface.perceive({**surface.messages, "car-2": variable})
    best = sharp.prepare(ego, others).detect(list(others))[0]
    place = logits.argmax()
    shown = geometry[place].detach().numpy()
    np.testing.assert_allclose(shown[:4], [*best[:2], *np.log(best[2:4])], atol=1e-3)
    np.testing.assert_allclose(shown[4:], [np.cos(2 * best[4]), np.sin(2 * best[4])], atol=1e-3)
    (gradient,) = torch.autograd.grad(geometry[place, 0], variable)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().sum() > 0


@pytest.mark.parametrize(("fusion", "expected"), [("mean", [2.0, 0.0]), ("max", [5.0, 1.0]), ("sum", [6.0, 0.0])])
def test_fusions(fusion, expected):
    maps = [torch.tensor(values).reshape(1, 1, 2) for values in ([1.0, 1.0], [5.0, 0.0], [0.0, -1.0])]
    assert FUSIONS[fusion](torch.stack(maps), dim=0).flatten().tolist() == expected


def test_maps_are_fused_as_they_lie_in_memory(v2xsim, ego, others):
    """Prepared ones have the channels of a cell side by side; those of an attacker's surface are in C order."""
    prepared = v2xsim.prepare(ego, others)
    maps = [prepared.own, *prepared.warped.values()]
    fused, in_c_order = v2xsim.fused(maps), v2xsim.fused([each.contiguous() for each in maps])
    np.testing.assert_allclose(fused, in_c_order, rtol=1e-6)
    assert fused.stride() == maps[0].stride() == (1, 32 * 256, 256)
    assert in_c_order.is_contiguous()


def test_the_recipe_chooses_the_fusion(published_state, v2xsim, ego, others, tmp_path):
    write_weights(published_state, "max", tmp_path / "max.safetensors")
    detector = load(str(tmp_path / "max.safetensors"))
    assert detector.info.name == "v2x-sim-max"
    with torch.no_grad():
        surfaces = [d.attack_surface(ego, others) for d in (detector, v2xsim)]
        largest, mean = (surface.class_logits(surface.messages) for surface in surfaces)
    assert not torch.allclose(largest, mean, atol=1e-2)


def test_weights_files_are_opened_by_what_they_are_for(weights, tmp_path):
    detector = load(str(weights))
    assert isinstance(detector, V2XSimDetector)
    assert detector.info.name == "v2x-sim-mean"
    changed = rewritten(tmp_path, SHIPPED_WEIGHTS, lambda tensors, recipe: recipe.update(consensus_score=0.5))
    other = load(str(changed))
    assert isinstance(other, EmbeddedDetector)
    assert other.info.consensus_score == 0.5
    assert available() == ("intersection-mean",)  # no weights ship
    unknown = rewritten(tmp_path, weights, lambda tensors, recipe: recipe.update(detector="nonesuch"))
    with pytest.raises(WeightsError, match="unknown detector, 'nonesuch'"):
        load(str(unknown))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors, recipe: tensors.pop("decoder.conv5_1.bias"), "decoder.conv5_1.bias missing"),
        (lambda tensors, recipe: recipe.update(fusion="median"), "'median', not one of v2x-sim-mean"),
        (lambda tensors, recipe: recipe.update(fusion="max"), "'v2x-sim-mean' with the fusion 'max'"),
    ],
)
def test_weights_of_another_network_are_refused(change, message, weights, tmp_path):
    with pytest.raises(WeightsError, match=message):
        V2XSimDetector(rewritten(tmp_path, weights, change))


def test_a_damaged_file_is_refused(weights, tmp_path):
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(data)
    with pytest.raises(WeightsError, match="is damaged"):
        load(str(path))
