import numpy as np
import pytest
import torch

from robosac.detectors import Message, WeightsError
from robosac.detectors.v2xsim.network import V2XSimNetwork, published_shapes, select_published
from robosac.detectors.v2xsim.voxels import AREA_M, from_indices, unpack
from robosac.detectors.warp import sampling_matrix, warp
from tests.robosac.detectors.v2xsim.recipe import made_up, noise, published_keys

EGO = 1
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def network(published_state) -> V2XSimNetwork:
    return V2XSimNetwork(select_published(published_state))


@pytest.fixture(scope="module")
def encoded(network, parity):
    """x, x1, x2, x3 and x4 of every agent."""
    with torch.inference_mode():
        grids = [from_indices(parity[f"voxel_indices_{k}"]).transpose(2, 0, 1) for k in range(6)]
        levels = [network.levels(torch.from_numpy(grid[None].astype(np.float32))) for grid in grids]
        return [[*own, network.deepest(own[3])] for own in levels]


@pytest.fixture(scope="module")
def warped(team):
    """Every teammate's map in the ego's frame."""
    with torch.inference_mode():
        return {k: moved(team[EGO], team[k]) for k in range(6) if k != EGO}


def moved(ego: Message, teammate: Message) -> torch.Tensor:
    matrix = torch.from_numpy(sampling_matrix(ego.pose, teammate.pose, AREA_M, mirrored=True)).float()
    return warp(torch.from_numpy(teammate.tensors["features"])[None], matrix[None])[0]


def statistics(values):
    values = np.asarray(values, dtype=np.float64)
    return [values.mean(), values.std(), np.abs(values).max()]


def test_the_made_up_weights_are_those_of_the_golden_data(parity):
    shapes = {key: shape for key, shape, _ in published_keys()}
    for i, key in enumerate(parity["recipe_check_keys"]):
        tensor = made_up(str(key), shapes[str(key)])
        np.testing.assert_allclose(tensor.flatten()[:4], parity["recipe_check_first4"][i], atol=1e-7)
        assert float(tensor.double().sum()) == pytest.approx(parity["recipe_check_sum"][i], abs=1e-3)


def test_the_tensors_taken_are_those_that_the_published_network_uses():
    used = {key: shape for key, shape, used in published_keys() if used and not key.endswith("num_batches_tracked")}
    assert published_shapes() == used


def test_the_encoder_gives_the_published_levels(encoded, parity):
    for level in range(5):
        ego = encoded[EGO][level][0, 0].numpy()
        step = 2 if level == 0 else 1
        np.testing.assert_allclose(ego[::step, ::step], parity[f"enc_x{level}_ego1_ch0"], atol=TOLERANCE)
        for own, expected in zip(encoded, parity[f"enc_x{level}_stats"], strict=True):
            np.testing.assert_allclose(statistics(own[level]), expected, atol=TOLERANCE)


def test_messages_are_the_published_feature_maps(team, parity):
    for message, flipped in zip(team, parity["enc_x3_flipped_ch0_8"], strict=True):
        np.testing.assert_allclose(message.tensors["features"][:8], flipped[:, ::-1], atol=TOLERANCE)


def test_the_sampling_matrix_is_the_published_one_seen_unflipped(team, parity):
    flip = np.array([[1, -1, 1], [-1, 1, -1]])
    ours = sampling_matrix(team[EGO].pose, team[0].pose, AREA_M, mirrored=True)
    np.testing.assert_allclose(ours * flip, parity["theta_0_to_1"], atol=1e-6)


@pytest.mark.parametrize("teammate", [0, 2, 3, 5])
def test_warped_maps_are_the_published_ones(teammate, warped, parity):
    published = parity[f"warp_{teammate}_to_1_ch0_8"]
    np.testing.assert_allclose(warped[teammate][:8], published[:, ::-1], atol=TOLERANCE)


@pytest.mark.parametrize(
    ("case", "teammates", "attacked"),
    [
        ("no_fuse_ego1", (), False),
        ("collab_empty_ego1", (), False),
        ("all_ego1", (0, 2, 3, 4, 5), False),
        ("collab_0_3_ego1", (0, 3), False),
        ("pert_all_ego1", (0, 2, 3, 4, 5), True),
        ("pert_collab_0_3_ego1", (0, 3), True),
    ],
)
def test_logits_and_codes_are_the_published_ones(case, teammates, attacked, v2xsim, network, team, warped, parity):
    """The published implementation perturbs an attacker's map after the warp, its rows still reversed; attacks on the
    detector perturb the message.
    """
    maps = dict(warped)
    if attacked:
        perturbation = torch.from_numpy((2 * noise("pert", (6, 256, 32, 32)) - 1) * 0.8).float()
        np.testing.assert_allclose(perturbation.flatten()[:4], parity["recipe_check_pert_first4"], atol=1e-6)
        for attacker in parity["attackers"]:
            bound = float(parity["eps"])
            maps[attacker] = maps[attacker] + perturbation[attacker].clamp(-bound, bound).flip(1)
    own = torch.from_numpy(team[EGO].tensors["features"])
    grid = unpack(torch.from_numpy(team[EGO].tensors["grid"]))[0].permute(2, 0, 1).numpy().astype(np.float32)
    with torch.inference_mode():
        context = network.context(torch.from_numpy(grid)[None], own[None])
        fused = v2xsim._fusion(torch.stack([own, *(maps[k] for k in teammates)]), dim=0)
        logits, codes = network.decode(fused[None], context)
    np.testing.assert_allclose(logits[parity["anchor_idx"]], parity[f"{case}__cls"], atol=TOLERANCE)
    np.testing.assert_allclose(codes[parity["anchor_idx"]], parity[f"{case}__loc"], atol=TOLERANCE)
    np.testing.assert_allclose([*statistics(logits), *statistics(codes)], parity[f"{case}__stats"], atol=TOLERANCE)


def without(key):
    return lambda state: state.pop(key)


def replaced(key, value):
    return lambda state: state.update({key: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("module.decoder.conv5_1.bias"), r"decoder\.conv5_1\.bias missing"),
        (lambda state: state.clear(), r"and \d+ more missing"),
        (
            replaced("module.decoder.conv5_1.weight", torch.zeros(256, 512, 3, 3)),
            r"shape \[256, 768, 3, 3\], got \[256, 512, 3, 3\]",
        ),
        (replaced("module.classification.conv2.bias", torch.full((12,), torch.nan)), "NaN"),
        (replaced("module.classification.conv2.bias", [0.0] * 12), "must be a tensor, got list"),
    ],
)
def test_a_checkpoint_of_another_network_is_refused(change, message, published_state):
    state = dict(published_state)
    change(state)
    with pytest.raises(WeightsError, match=message):
        select_published(state)


def test_what_is_not_used_may_be_missing_and_the_prefix_too(published_state, network):
    used = published_shapes()
    plain = {k.removeprefix("module."): v for k, v in published_state.items() if k.removeprefix("module.") in used}
    assert select_published(plain).keys() == used.keys()
