import numpy as np
import pytest
import torch

from robosac.boxes import corners
from robosac.detectors.v2xsim.anchors import MAX_CANDIDATES, anchor_boxes, decode, detections, geometry, to_lidar
from tests.conftest import GOLDEN

ANCHORS = 256 * 256 * 6


@pytest.fixture(scope="module")
def golden():
    with np.load(GOLDEN / "nms_decode.npz") as file:
        return dict(file)


def ours(published_corners):
    """Corners as the published code lists them, from front left on and in the LiDAR's frame."""
    return published_corners[:, [1, 2, 3, 0]] * [-1.0, 1.0]


def heads(golden, case):
    logits = torch.from_numpy(np.tile(golden["default_logits"], (ANCHORS, 1)))
    codes = torch.from_numpy(np.tile(golden["default_loc"], (ANCHORS, 1)))
    index = torch.from_numpy(golden[f"{case}_anchor_idx"])
    logits[index], codes[index] = (torch.from_numpy(golden[f"{case}_{name}"]) for name in ("logits", "loc"))
    return logits[:, 1] - logits[:, 0], codes


def test_the_anchor_table_is_the_published_one(golden):
    row, column, k = np.meshgrid(range(2), range(2), range(6), indexing="ij")
    index = (row * 256 + column) * 6 + k
    np.testing.assert_allclose(
        anchor_boxes(index.ravel()), golden["anchors_first2rows"].reshape(-1, 6), atol=1e-6, rtol=0
    )
    np.testing.assert_allclose(anchor_boxes(np.arange(ANCHORS - 6, ANCHORS)), golden["anchors_last"], atol=1e-6)


def test_codes_are_decoded_as_published(golden):
    boxes = decode(anchor_boxes(golden["dec_anchor_idx"]), golden["dec_code"])
    np.testing.assert_allclose(boxes, golden["dec_box"], atol=1e-4)
    np.testing.assert_allclose(corners(to_lidar(boxes)), ours(golden["dec_corners"]), atol=1e-4)


@pytest.mark.parametrize("case", [0, 1, 3, 5])
def test_the_published_detections_are_kept(case, golden):
    boxes, anchor = detections(*heads(golden, case))
    assert anchor.tolist() == golden[f"{case}_kept_anchor_idx"].tolist()
    np.testing.assert_allclose(boxes[:, 5], golden[f"{case}_score"], atol=1e-6)
    np.testing.assert_allclose(corners(boxes), ours(golden[f"{case}_corners"]), atol=1e-4)


def test_a_box_points_where_its_anchor_does():
    upright, across, slanted = to_lidar(anchor_boxes(np.array([0, 1, 2])))
    assert upright[:5].tolist() == pytest.approx([31.875, -31.875, 4.0, 2.0, np.pi / 2])  # along y
    assert abs(np.sin(across[4])) == pytest.approx(0.0, abs=1e-9)  # along x
    assert np.tan(slanted[4]) == pytest.approx(1.0)


def test_a_flooded_frame_is_bounded_and_finite(rng):
    logits = torch.from_numpy(rng.normal(0, 70, ANCHORS).astype(np.float32))
    codes = torch.from_numpy(rng.normal(0, 1e3, (ANCHORS, 6)).astype(np.float32))
    boxes, anchor = detections(logits, codes)
    assert 0 < len(boxes) <= MAX_CANDIDATES
    assert np.isfinite(boxes).all()
    assert logits[anchor].min() >= logits.sort().values[-MAX_CANDIDATES]


def test_what_overflowed_is_no_box():
    logits, codes = torch.zeros(ANCHORS), torch.zeros(ANCHORS, 6)
    logits[[7, 3000]] = 5.0
    logits[90_000] = torch.nan
    codes[7, 0] = torch.inf
    _, anchor = detections(logits, codes)
    assert anchor.tolist() == [3000]


def test_an_attacker_sees_the_boxes_that_are_decoded(rng):
    codes = rng.normal(0.0, 0.5, (ANCHORS, 6)).astype(np.float32)
    index = rng.choice(ANCHORS, 500, replace=False)
    boxes = to_lidar(decode(anchor_boxes(index), codes[index]))
    expected = [*boxes.T[:2], *np.log(boxes.T[2:4]), np.cos(2 * boxes[:, 4]), np.sin(2 * boxes[:, 4])]
    variable = torch.from_numpy(codes).requires_grad_(True)
    shown = geometry(variable)
    np.testing.assert_allclose(shown.detach()[torch.from_numpy(index)], np.column_stack(expected), atol=2e-3)
    (gradient,) = torch.autograd.grad(shown.sum(), variable)
    assert torch.isfinite(gradient).all()
    silent = torch.zeros(ANCHORS, 6, requires_grad=True)  # the norm of sine and cosine is 0
    (gradient,) = torch.autograd.grad(geometry(silent).sum(), silent)
    assert torch.isfinite(gradient).all()
