"""What only an accelerator shows, of the V2X-Sim layout."""

import pytest
import torch

from robosac.detectors import load
from robosac.detectors.loading import warm_up
from robosac.detectors.v2xsim import write_weights
from robosac.detectors.v2xsim.anchors import detections_there
from tests.robosac.detectors.alike import check_alike, subsets_of

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no accelerator")


@torch.inference_mode()
@pytest.mark.parametrize("precision", ["float32", "float16"])
@pytest.mark.parametrize("fusion", ["mean", "max", "sum"])
def test_what_is_seen_there_is_what_is_seen_here(fusion, precision, published_state, tmp_path, team):
    path = tmp_path / f"{fusion}.safetensors"
    write_weights(published_state, fusion, path)
    far, here = load(f"{path}@{precision}", device="cuda"), load(path)
    warm_up(far)
    teams = [(team[0], {"a": team[1], "b": team[2], "c": team[3]}), (team[3], {"a": team[4]})]
    frames = [(far.prepare(*of), here.prepare(*of), subsets_of(of[1])) for of in teams]
    for there, right, subsets in frames:
        fused = there._fused_for(subsets)
        expected, _ = here._fast.decode(right._fused_for(subsets), right._context)
        # of boxes that mean nothing many more come and go than of such that are vehicles
        logits, _ = far._fast.decode(fused, there._context)
        assert (logits.cpu() - expected).norm() < 0.02 * expected.norm()
        for boxes, again in zip(there.detect_all(subsets), unrecorded(far, fused, there._context), strict=True):
            check_alike(boxes, again)
    wanted = [(there, subsets[:2]) for there, _, subsets in frames]
    for found, (there, subsets) in zip(frames[0][0].detect_together(wanted), wanted, strict=True):
        for boxes, alone in zip(found, there.detect_all(subsets), strict=True):
            check_alike(boxes, alone)


def unrecorded(detector, fused, context):
    return detections_there(detector._found_there(fused, *context))
