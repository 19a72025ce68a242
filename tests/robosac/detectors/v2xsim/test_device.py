import numpy as np
import pytest
import torch

from robosac.detectors import load
from robosac.detectors.v2xsim import anchors, write_weights
from tests.robosac.detectors.elsewhere import elsewhere

ANCHORS = 256 * 256 * 6


@pytest.mark.parametrize("fusion", ["mean", "max", "sum"])
def test_a_frame_is_prepared_and_decoded_there(fusion, published_state, tmp_path, team):
    path = tmp_path / f"{fusion}.safetensors"
    write_weights(published_state, fusion, path)
    ego, others = team[0], {f"car-{k}": message for k, message in enumerate(team[1:4])}
    here = load(path).prepare(ego, others)
    with elsewhere() as device:
        far = load(path, device=device)
        prepared = far.prepare(ego, others)
        assert {maps.device.type for maps in (prepared.own, *prepared.warped.values())} == {device}
        found = [prepared.detect(subset) for subset in ((), ("car-0", "car-2"))]
    assert far.info.device == device
    for boxes, expected in zip(found, [here.detect(), here.detect(("car-0", "car-2"))], strict=True):
        assert len(expected) > 0
        np.testing.assert_allclose(boxes, expected, atol=1e-4)  # how many rows one multiplies changes how it rounds


@pytest.mark.parametrize("candidates", [0, 40, 5000])
def test_the_same_anchors_are_found_there(candidates, rng):
    logits = torch.from_numpy(rng.normal(-5, 0.5, (2, ANCHORS)).astype(np.float32))
    logits[1, torch.from_numpy(rng.choice(ANCHORS, candidates, replace=False))] = torch.linspace(1, 9, candidates)
    logits[0, 7:5000] = torch.nan
    codes = torch.from_numpy(rng.normal(0, 1, (2 * ANCHORS, 6)).astype(np.float32))
    found = list(anchors.picked_there(logits, codes, 0.5))
    for there, here in zip(found, anchors.picked(logits, codes, 0.5), strict=True):
        for one, other in zip(there, here, strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(found[1][0]) == min(candidates, anchors.MAX_CANDIDATES)
