import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from robosac.detectors import load
from robosac.detectors.map_fusion import WORTH
from robosac.detectors.v2xsim import anchors, write_weights
from tests.robosac.detectors.elsewhere import elsewhere

ANCHORS = 256 * 256 * 6
SUBSETS = [(), ("car-0", "car-2"), ("car-1",), ("car-0", "car-1", "car-2")]


def check_same(boxes, right):
    """Two whose scores differ by less than a rounding may change places."""
    assert len(boxes) == len(right)
    order = cdist(right[:, :2], boxes[:, :2]).argmin(axis=1)
    assert sorted(order) == list(range(len(right)))
    for these in (boxes[order], np.column_stack([boxes[order, :5], boxes[:, 5]])):
        np.testing.assert_allclose(these, right, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("fusion", ["max", "sum"])
def test_a_frame_is_prepared_and_decoded_there(fusion, published_state, tmp_path, team):
    path = tmp_path / f"{fusion}.safetensors"
    write_weights(published_state, fusion, path)
    ego, others = team[0], {f"car-{k}": message for k, message in enumerate(team[1:4])}
    here = load(path).prepare(ego, others)
    with elsewhere() as device:
        far = load(path, device=device)
        prepared = far.prepare(ego, others)
        assert {maps.device.type for maps in (prepared.own, *prepared.warped.values())} == {device}
        found = [prepared.detect(subset) for subset in SUBSETS]
        at_once = prepared.detect_all(SUBSETS)
    assert (far.info.device, prepared.worth, here.worth) == (device, WORTH, 1)
    expected = [here.detect(subset) for subset in SUBSETS]
    assert min(map(len, expected)) > 0
    # how many rows one multiplies, and in which order one sums, changes how it is rounded
    for one, another, and_here, right in zip(found, at_once, here.detect_all(SUBSETS), expected, strict=True):
        for boxes in (one, another, and_here):
            check_same(boxes, right)


def test_frames_of_several_egos_are_decoded_at_once(published_state, tmp_path, team):
    path = tmp_path / "mean.safetensors"
    write_weights(published_state, "mean", path)
    teams = [(team[0], {"a": team[1], "b": team[2]}), (team[3], {"a": team[4]}), (team[4], {})]
    subsets = [[("a",), (), ("a", "b")], [("a",)], [()]]
    here = [load(path).prepare(ego, others) for ego, others in teams]
    with elsewhere() as device:
        far = load(path, device=device)
        frames = [far.prepare(ego, others) for ego, others in teams]
        assert {frame.family for frame in frames} == {far}
        found = frames[1].detect_together(list(zip(frames, subsets, strict=True)))
    assert [len(of_frame) for of_frame in found] == [3, 1, 1]
    for frame, asked, boxes in zip(here, subsets, found, strict=True):
        for subset, of_subset in zip(asked, boxes, strict=True):
            check_same(of_subset, frame.detect(subset))


@pytest.mark.parametrize("fusion", ["mean", "sum"])
def test_what_overflows_in_one_message_spoils_no_fusion_without_it(fusion, published_state, tmp_path, team):
    path = tmp_path / f"{fusion}.safetensors"
    write_weights(published_state, fusion, path)
    prepared = load(path).prepare(team[0], {f"car-{k}": message for k, message in enumerate(team[1:3])})
    prepared.warped["car-0"] = torch.full_like(prepared.warped["car-0"], torch.inf)
    spoilt, sound = prepared.detect_all([("car-0", "car-1"), ("car-1",)])
    np.testing.assert_allclose(sound, prepared.detect(("car-1",)), rtol=1e-5, atol=1e-3)
    assert np.isfinite(spoilt).all()


@pytest.mark.parametrize("candidates", [0, 40, 256, 5000])
def test_the_same_boxes_are_made_of_what_is_found_there(candidates, rng):
    logits = torch.from_numpy(rng.normal(-5, 0.5, (2, ANCHORS)).astype(np.float32))
    logits[1, torch.from_numpy(rng.choice(ANCHORS, candidates, replace=False))] = torch.linspace(1, 9, candidates)
    logits[0, 7:5000] = torch.nan
    codes = torch.from_numpy(rng.normal(0, 1, (2 * ANCHORS, 6)).astype(np.float32))
    codes[ANCHORS + int(logits[1].argmax())] = torch.inf
    found = anchors.detections_there(anchors.found_there(logits, codes, 0.7))
    expected = anchors.detections_of_each(logits, codes, 0.7)
    for there, (here, _) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(there, here)
    assert (len(found[1]) > 0) == (candidates > 0)
