from contextlib import nullcontext

import numpy as np
import pytest
import torch

from robosac.boxes import nms
from robosac.detectors import suppression
from robosac.detectors.suppression import LOOKED_AT, ROUNDS, brought_back, suppressed


@pytest.fixture(params=["cpu", *["cuda"] * torch.cuda.is_available()])
def found(request):
    """What is brought back of boxes (n, k, 5) with logits (n, k), the codes of each box its number."""

    def find(boxes, logits, iou):
        numbers = torch.arange(boxes.shape[1]).to(request.param).expand(logits.shape)
        value, box = (torch.from_numpy(each).float().to(request.param) for each in (logits, boxes))
        codes = numbers[..., None].float()
        return list(brought_back(*suppressed(value, numbers, codes, box[:, :LOOKED_AT], iou)))

    find.device = request.param
    return find


def crowd(rng, maps, count, within_m):
    """Boxes (maps, count, 5) about cars, best first."""
    size = rng.uniform([3.0, 1.5], [12.0, 3.0], (maps, count, 2))
    places = rng.uniform(-within_m, within_m, (maps, count, 2))
    logits = -np.sort(-rng.normal(2.0, 1.0, (maps, count)), axis=1)
    return np.concatenate([places, size, rng.uniform(-4, 4, (maps, count, 1))], axis=2).astype(np.float32), logits


@pytest.mark.parametrize("iou", [0.01, 0.1, 0.5])
@pytest.mark.parametrize(("count", "within_m"), [(40, 30.0), (200, 30.0), (200, 8.0), (3, 0.5)])
def test_who_survives_is_who_survives_on_the_processor(iou, count, within_m, rng, found):
    boxes, logits = crowd(rng, 4, count, within_m)
    for i, ((index, value, codes), done) in enumerate(found(boxes, logits, iou)):
        assert done
        assert index.tolist() == nms(boxes[i], logits[i], iou).tolist() == codes[:, 0].tolist()
        np.testing.assert_allclose(value, logits[i, index], rtol=1e-6)


def test_a_box_in_another_and_the_same_box_twice_are_suppressed(found):
    boxes = np.array([[[0, 0, 4, 2, 0.3], [0.2, 0, 2, 1, 0.3], [0, 0, 4, 2, 0.3], [9, 9, 4, 2, 0], [9, 11.1, 4, 2, 0]]])
    (((index, _, _), done),) = found(boxes, np.array([[5.0, 4, 3, 2, 1]]), 0.1)
    assert (index.tolist(), done) == ([0, 3, 4], True)


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 25))
def test_who_is_side_by_side_is_not_suppressed(yaw, found, rng):
    """Edges of one are along those of the other then, and how far they are from that is all rounding."""
    boxes = crowd(rng, 64, 2, 30.0)[0]
    boxes[:, :, 4] = yaw
    apart_m = boxes[:, :, 3].sum(axis=1) / 2 + rng.uniform(0.1, 2.0, 64)
    along_m = rng.uniform(-4.0, 4.0, 64)
    boxes[:, 1, 0] = boxes[:, 0, 0] + np.cos(yaw) * along_m - np.sin(yaw) * apart_m
    boxes[:, 1, 1] = boxes[:, 0, 1] + np.sin(yaw) * along_m + np.cos(yaw) * apart_m
    assert [index.tolist() for (index, _, _), _ in found(boxes, np.tile([2.0, 1.0], (64, 1)), 0.01)] == [[0, 1]] * 64


def test_what_is_no_candidate_suppresses_nothing(found):
    boxes, logits = np.tile([0.0, 0, 4, 2, 0], (1, 3, 1)), np.array([[-np.inf, 2.0, 1.0]])
    boxes[0, 0] = np.nan
    (((index, _, _), done),) = found(boxes, logits, 0.1)
    assert (index.tolist(), done) == ([1], True)


@pytest.mark.parametrize(("links", "settled"), [(ROUNDS - 1, True), (ROUNDS + 3, False)])
def test_where_suppressions_follow_from_one_another_for_long_the_processor_suppresses(links, settled, found):
    """A row in which each overlaps its neighbours only, best first from one end."""
    boxes = np.tile([0.0, 0, 4, 2, 0], (1, links, 1))
    boxes[0, :, 0] = 3.0 * np.arange(links)
    logits = -np.arange(links, dtype=float)[None]
    (((index, _, _), done),) = found(boxes, logits, 0.1)
    settled |= found.device == "cuda"  # one after the other there
    assert done == settled
    assert index.tolist() == list(range(0, links, 2 if settled else 1))


def test_of_more_than_are_looked_at_all_come_back_by_their_number(found):
    count = LOOKED_AT + 1
    boxes = np.tile([0.0, 0, 4, 2, 0], (2, count, 1))
    logits = np.tile(-np.arange(count, dtype=float), (2, 1))
    logits[1, -1] = -np.inf
    more, fits = found(boxes, logits, 0.1)
    assert (more[0][0].tolist(), more[1]) == (list(range(count)), False)
    assert (fits[0][0].tolist(), fits[1]) == ([0], True)


def test_where_torch_cannot_compile_the_kernels_it_is_told_and_done_without(monkeypatch, caplog):
    def fails(source, name):
        assert "__global__ void compare(" in source
        raise RuntimeError(f"no NVRTC for {name}")

    monkeypatch.setattr(torch.cuda, "_compile_kernel", fails)
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    assert suppression._kernels(torch.device("cuda:7")) is None
    assert suppression._kernels(torch.device("cpu")) is None
    assert [record.getMessage() for record in caplog.records] == [
        "boxes are suppressed on cuda:7 without a kernel, which takes longer: no NVRTC for compare"
    ]
