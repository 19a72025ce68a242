"""What only an accelerator shows, of the V2X-Sim layout."""

import pytest
import torch

from robosac.detectors import load
from robosac.detectors.loading import warm_up
from robosac.detectors.v2xsim import write_weights
from tests.robosac.detectors.alike import check_alike, subsets_of

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no accelerator")


@pytest.mark.parametrize("precision", ["float32", "float16"])
@pytest.mark.parametrize("fusion", ["mean", "max", "sum"])
def test_what_is_seen_there_is_what_is_seen_here(fusion, precision, published_state, tmp_path, team):
    path = tmp_path / f"{fusion}.safetensors"
    write_weights(published_state, fusion, path)
    far, here = load(f"{path}@{precision}", device="cuda"), load(path)
    warm_up(far)
    teams = [(team[0], {"a": team[1], "b": team[2], "c": team[3]}), (team[3], {"a": team[4]})]
    frames = [(far.prepare(*of), here.prepare(*of)) for of in teams]
    for (there, right), (_, others) in zip(frames, teams, strict=True):
        subsets = subsets_of(others)
        for subset, boxes in zip(subsets, there.detect_all(subsets), strict=True):
            check_alike(boxes, right.detect(subset))
    wanted = [(there, [(), ("a",)]) for there, _ in frames]
    for found, (_, right) in zip(frames[0][0].detect_together(wanted), frames, strict=True):
        check_alike(found[1], right.detect(("a",)))
