import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from robosac.attacks import PGD
from robosac.attacks.hearing import Hearing
from robosac.calibrated import witness_of
from robosac.defenses import EGO
from robosac.detectors import decoding, load
from robosac.detectors.base import Placeable
from robosac.detectors.device import CPU, as_device, by_cell, stacked
from tests.robosac.detectors.elsewhere import elsewhere


@pytest.fixture(scope="module")
def there():
    with elsewhere() as device:
        yield device


@pytest.fixture(scope="module")
def far(there):
    return load(device=there)


@pytest.mark.parametrize("device", ["nonsense", "meta", "", "cuda:x", "cuda:63"])
def test_a_device_that_is_not_there_is_refused(device):
    with pytest.raises(ValueError, match=f"^torch cannot compute on the device {device!r} here: .") as refused:
        load(device=device)
    assert "\n" not in str(refused.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is one")
def test_an_accelerator_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="the device 'cuda' here"):
        load(device="cuda")


def test_the_processor_is_one_device_by_any_name(detector):
    assert as_device("cpu:0") == as_device("cpu") == CPU
    assert load(device="cpu:0").info.device == detector.info.device == "cpu"


def test_a_detector_that_knows_no_devices_is_refused_but_on_the_processor(there, detector, monkeypatch):
    own = SimpleNamespace(info=detector.info, prepare=detector.prepare)
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(build=lambda: own))
    assert load("own:build") is own
    with pytest.raises(ValueError, match="own:build cannot compute on elsewhere: it has no method on_device"):
        load("own:build", device=there)


def test_a_frame_is_prepared_and_decoded_there(far, there, detector, ego_message, benign):
    prepared, here = far.prepare(ego_message, benign), detector.prepare(ego_message, benign)
    assert {maps.device for maps in (prepared.own, *prepared.warped.values())} == {torch.device(there)}
    for subset in ((), ("rsu",), tuple(benign)):
        np.testing.assert_allclose(prepared.detect(subset), here.detect(subset), atol=1e-4)
    assert far.info == detector.info
    assert far.info.device == there


def test_tensors_of_two_devices_do_not_meet_there(far, ego_message, benign):
    """As on an accelerator; what the other tests here rest on."""
    prepared = far.prepare(ego_message, benign)
    prepared.warped["rsu"] = prepared.warped["rsu"].cpu()
    with pytest.raises(RuntimeError, match="some tensors are on the processor"):
        prepared.detect(("rsu",))
    with pytest.raises((RuntimeError, TypeError)):
        prepared.own.numpy()


def test_nothing_is_shared_with_the_detector_that_was_placed(there, detector, ego_message):
    far = detector.on_device(there)
    assert isinstance(detector, Placeable)
    near = far.on_device("cpu")
    with torch.inference_mode():
        near._placed.steps[-1].bias += 5.0
    found = far.prepare(ego_message, {}).detect()
    np.testing.assert_allclose(detector.prepare(ego_message, {}).detect(), found, atol=1e-4)
    assert (detector.info.device, far.info.device, near.info.device) == ("cpu", there, "cpu")


def test_precision_and_device_go_together(there, ego_message, benign):
    narrow = load("intersection-mean@bfloat16")
    for far in (load("intersection-mean@bfloat16", device=there), load(device=there).in_precision("bfloat16")):
        assert (far.info.name, far.info.device) == ("intersection-mean@bfloat16", there)
        assert far._placed.steps[-1].weight.device.type == there
        found, expected = (each.prepare(ego_message, benign).detect(list(benign)) for each in (far, narrow))
        np.testing.assert_allclose(found[:10], expected[:10], atol=0.05)


def test_the_witness_reads_there_and_gives_arrays(far, there, detector, ego_message, benign):
    messages = {EGO: ego_message, **benign}
    witness, here = witness_of(far.info), witness_of(detector.info)
    assert witness is not here
    assert next(witness.network.parameters()).device.type == there
    said, expected = (each.testify(EGO, messages) for each in (witness, here))
    np.testing.assert_array_equal(said.maps, expected.maps)
    np.testing.assert_array_equal(witness.read_message(ego_message), here.read_message(ego_message))


def test_attackers_compute_on_the_processor(far, detector, ego_message, benign):
    surfaces = [each.attack_surface(ego_message, benign) for each in (far, detector)]
    made, expected = (PGD(steps=1).run(surface, ["rsu"], np.random.default_rng(0))["rsu"] for surface in surfaces)
    assert torch.equal(made, expected)
    assert far.perturbed(benign["rsu"], made).tensors["features"].dtype == np.float16


def test_they_hear_there_what_is_said_here(far, detector, ego_message, benign):
    poses = {name: message.pose for name, message in benign.items()}
    messages = detector.attack_surface(ego_message, benign).messages
    there, here = (Hearing.of(info, ego_message, messages, poses) for info in (far.info, detector.info))
    assert torch.equal(there.hear(messages)._maps, here.hear(messages)._maps)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint8])
def test_what_goes_up_is_widened_there(kind, there, rng):
    arrays = [(100 * rng.random((2, 3, 4))).astype(kind).transpose(1, 2, 0) for _ in range(3)]
    for device in (CPU, torch.device(there)):
        maps = stacked(arrays, device)
        assert (maps.device.type, maps.dtype, maps.is_contiguous()) == (device.type, torch.float32, True)
        np.testing.assert_array_equal(maps.cpu().numpy(), np.stack(arrays).astype(np.float32))


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint8])
def test_maps_go_up_cell_by_cell(kind, there, rng):
    maps = [(100 * rng.random((2, 3, 4))).astype(kind).transpose(1, 2, 0) for _ in range(3)]
    for device in (CPU, torch.device(there)):
        cells = by_cell(maps, device)
        assert (cells.device.type, cells.dtype, cells.stride()) == (device.type, torch.float32, (24, 1, 6, 3))
        np.testing.assert_array_equal(cells.cpu().numpy(), np.stack(maps).astype(np.float32))


@pytest.mark.parametrize("peaks", ["none", "some", "more than are looked at"])
def test_the_same_boxes_are_made_of_what_is_found_there(peaks, rng):
    height = {"none": -1e3, "some": -4.0, "more than are looked at": 3.0}[peaks]
    logits = torch.from_numpy(rng.normal(height, 1.5, (3, 64, 64)).astype(np.float32))
    logits[0, 20:30] = torch.nan
    codes = torch.from_numpy(rng.normal(0.0, 1.0, (3, 6, 64, 64)).astype(np.float32))
    found = decoding.boxes_there(decoding.found_there(logits, codes, 0.5))
    expected = decoding.decode_all(logits, codes, 0.5)
    for there, here in zip(found, expected, strict=True):
        np.testing.assert_array_equal(there, here)
    assert (len(expected[2]) == 0) == (peaks == "none")
    candidates = [len(index) for index, _, _ in decoding.picked(logits, codes, 0.0)]
    assert (candidates[2] == decoding.MAX_PEAKS) == (peaks == "more than are looked at")
