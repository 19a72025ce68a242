import numpy as np
import pytest
import torch

from robosac.detectors.base import in_precision
from robosac.detectors.loading import load
from robosac.detectors.v2xsim.anchors import detections
from robosac.detectors.v2xsim.fast import FastDecoder
from robosac.detectors.v2xsim.network import CODE, GRID, V2XSimNetwork, select_published
from robosac.detectors.v2xsim.voxels import from_indices

EGO = 1


@pytest.fixture(scope="module")
def network(published_state) -> V2XSimNetwork:
    return V2XSimNetwork(select_published(published_state))


@pytest.fixture(scope="module")
def frame(network, parity) -> tuple[torch.Tensor, torch.Tensor]:
    """The ego's occupancy, and a fused message."""
    grids = [from_indices(parity[f"voxel_indices_{k}"]).transpose(2, 0, 1)[None].astype(np.float32) for k in (EGO, 0)]
    with torch.inference_mode():
        own, other = (network.levels(torch.from_numpy(grid))[-1] for grid in grids)
        return torch.from_numpy(grids[0]), torch.cat([own, (own + other) / 2])


@pytest.fixture(scope="module")
def plain(network, frame):
    grid, maps = frame
    with torch.inference_mode():
        logits, codes = network.decode(maps[1:], network.context(grid, maps[:1]))
        return logits[:, 1] - logits[:, 0], codes


def decoded(network, frame, precision):
    grid, maps = frame
    fast = FastDecoder(network, precision)
    with torch.inference_mode():
        logits, codes = fast.decode(maps[1:], fast.context(grid, maps[:1]))
        return logits[0], codes


def test_in_float32_it_gives_what_the_plain_decoder_gives(network, frame, plain, rng):
    logits, codes = decoded(network, frame, "float32")
    torch.testing.assert_close(logits, plain[0], atol=1e-4, rtol=1e-4)
    corners = [0, GRID - 1, GRID * (GRID - 1), GRID * GRID - 1]
    cells = np.concatenate([corners, rng.integers(0, GRID * GRID, 500)])
    anchors = torch.from_numpy(cells[:, None] * CODE + np.arange(CODE)).flatten()
    with torch.inference_mode():
        torch.testing.assert_close(codes[anchors], plain[1][anchors], atol=1e-4, rtol=1e-4)


def test_no_anchor_has_no_code(network, frame):
    with torch.inference_mode():
        assert decoded(network, frame, "float32")[1][torch.zeros(0, dtype=torch.int64)].shape == (0, CODE)


def test_the_maps_of_a_frame_are_not_changed_by_decoding_it(network, frame):
    grid, maps = frame
    fast = FastDecoder(network)
    with torch.inference_mode():
        context = fast.context(grid, maps[:1])
        before = [term.clone() for term in context]
        first, second = (fast.decode(maps[1:], context)[0] for _ in range(2))
    torch.testing.assert_close(first, second, atol=0, rtol=0)
    assert all(torch.equal(term, kept) for term, kept in zip(context, before, strict=True))


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_in_a_narrow_precision_it_is_close(precision, network, frame, plain):
    logits, codes = decoded(network, frame, precision)
    assert logits.dtype == torch.float32
    error = (logits - plain[0]).abs()
    scale = float(plain[0].std())
    assert 0 < float(error.mean()) < 0.02 * scale
    anchors = torch.arange(0, len(logits), 997)
    with torch.inference_mode():
        assert float((codes[anchors] - plain[1][anchors]).abs().mean()) < 0.02 * float(plain[1].std())


def test_boxes_are_those_of_the_plain_decoder(v2xsim, team):
    others = {f"car-{k}": message for k, message in enumerate(team) if k != EGO}
    found = v2xsim.prepare(team[EGO], others).detect(["car-0", "car-2"])
    surface = v2xsim.attack_surface(team[EGO], {name: others[name] for name in ("car-0", "car-2")})
    with torch.inference_mode():
        logits, codes = surface._decode([surface._own, *surface._benign.values()])
    expected = detections(logits, codes, v2xsim._score_threshold)[0]
    assert len(expected) > 0
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_precision_is_asked_for_by_name(weights, v2xsim):
    narrow = load(f"{weights}@bfloat16")
    assert narrow.info == in_precision(v2xsim.info, "bfloat16")
    assert narrow.info.name == "v2x-sim-mean@bfloat16"
    assert load(f"{weights}@float32").info == in_precision(narrow.info, "float32") == v2xsim.info


def test_what_cannot_decode_in_a_precision_says_so(tmp_path, monkeypatch):
    (tmp_path / "coarse.py").write_text(
        "from robosac.detectors import EmbeddedDetector\n\nclass Coarse(EmbeddedDetector):\n    in_precision = None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="coarse:Coarse cannot decode in bfloat16"):
        load("coarse:Coarse@bfloat16")
