"""What a witness reads of messages, and how it lies."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from robosac.boxes import pose_matrix
from robosac.calibrated import witness_of
from robosac.detectors import DetectorInfo, Message, TensorSpec
from robosac.detectors.fast_witness import FastWitness
from robosac.detectors.weights_file import WeightsError
from robosac.detectors.witness import AT_ONCE, LARGEST, Witness
from robosac.detectors.witness_network import GEOMETRY, HIGHEST_M, USUAL_M, Layout, WitnessNetwork
from robosac.testimony import LAYERS, LIKELIHOOD, X

MAP = {"other": TensorSpec("float16", (2, 8, 8)), "map": TensorSpec("float32", (4, 16, 16))}
INFO = DetectorInfo("fake", {"ego": {}, "teammate": MAP}, (-32, -32, 32, 32), 4.0, "d" * 64, 0.5)
NAMES = ("", "a", "b")
POSES = [pose_matrix(0, 0, 1.6, 0), pose_matrix(12, -5, 2.0, 1.0), pose_matrix(-7, 9, 5.0, -2.5)]


def witness(info=INFO, scale=2.0):
    torch.manual_seed(3)
    layout = Layout.of(info, scale)
    return Witness(WitnessNetwork(layout.channels, layout.upsampling), layout)


def messages(rng, mirrored=False):
    maps = [rng.normal(size=(4, 16, 16)).astype(np.float32) for _ in NAMES]
    sent = [np.ascontiguousarray(m[..., ::-1]) if mirrored else m for m in maps]
    return {name: Message(pose, {"map": m}) for name, pose, m in zip(NAMES, POSES, sent, strict=True)}


def test_the_largest_map_of_floats_is_read_in_places_of_a_metre():
    layout = Layout.of(INFO, 2.0)
    assert (layout.tensor, layout.channels, layout.height, layout.width) == ("map", 4, 16, 16)
    assert layout.upsampling == 4
    assert layout.half_extent_m == 32.0
    finer = {"teammate": {"map": TensorSpec("float32", (4, 128, 128)), "ids": TensorSpec("int64", (4, 512, 512))}}
    assert Layout.of(replace(INFO, tensors=finer), 1.0).upsampling == 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tensors": {"teammate": {"x": TensorSpec("int8", (4, 16, 16))}}}, "no tensor"),
        ({"tensors": {"teammate": {"x": TensorSpec("float32", (16, 16))}}}, "no tensor"),
        ({"area_m": (-32, -32, 32, 31)}, "square around the sensor"),
        ({"area_m": (0, 0, 64, 64)}, "square around the sensor"),
    ],
)
def test_what_cannot_be_read_is_refused(change, reason):
    with pytest.raises(WeightsError, match=reason):
        Layout.of(replace(INFO, **change), 1.0)


def test_maps_mirrored_or_not_give_the_same_testimony():
    plain = witness().testify("", messages(np.random.default_rng(5)))
    info = replace(INFO, mirrored=True)
    mirrored = witness(info).testify("", messages(np.random.default_rng(5), mirrored=True))
    unflipped = witness(info).testify("", messages(np.random.default_rng(5)))
    np.testing.assert_array_equal(mirrored.maps, plain.maps)
    np.testing.assert_array_equal(mirrored.over_ego, plain.over_ego)
    assert np.abs(unflipped.maps - plain.maps).max() > 0.01


@pytest.mark.parametrize("mirrored", [False, True])
def test_messages_are_read_as_the_network_reads_maps(mirrored, rng):
    """Together and alone, whatever their size, and however high their sensors are."""
    sent, reader = messages(rng), witness(replace(INFO, mirrored=mirrored), scale=0.3)
    sent["high"] = Message(pose_matrix(0, 0, 400.0, 0), sent["a"].tensors)
    maps = reader.layout.maps(list(sent.values()))
    expected = reader.read(maps, [float(each.pose[2, 3]) for each in sent.values()]).numpy()
    assert np.abs(expected).max() < LARGEST
    said = reader.testify("", sent)
    np.testing.assert_allclose(said.maps, expected, rtol=1e-3, atol=1e-3)  # half floats
    for name, maps in zip(sent, expected, strict=True):
        np.testing.assert_allclose(reader.read_message(sent[name]), maps, rtol=1e-3, atol=1e-3)
        found = FastWitness(reader.network, reader.layout).read([sent[name]]).flatten(4).flatten(2, 3)[0]
        np.testing.assert_allclose(found, maps, atol=1e-5 * np.abs(maps).max())


@pytest.mark.parametrize(("precision", "least", "most"), [("bfloat16", 0.01, 0.3), ("float16", 0.001, 0.03)])
def test_with_a_narrow_detector_messages_are_read_in_its_precision(
    precision, least, most, detector, ego_message, benign
):
    """As the same, but for rounding."""
    sent = [ego_message, *benign.values()]
    wide, narrow = (witness_of(each.info) for each in (detector, detector.in_precision(precision)))
    assert witness_of(detector.info) is wide
    wide_maps, maps = (np.stack([reader.read_message(each) for each in sent]) for reader in (wide, narrow))
    off = np.abs(maps.astype(np.float64) - wide_maps).max(axis=(0, 2, 3))
    assert least < off[LIKELIHOOD] < most
    assert (off[X:] < 0.1).all()


def test_what_there_is_no_time_for_says_nothing(rng):
    """The ego's and the trusted are read first; what is read is as it would be with the others."""
    names = ["a", "b", "c", "", *"defghijklmnopqr"]
    sent = {name: messages(rng)["a"] for name in names}
    whole, asked = witness().testify("", sent), []

    def fits(group):
        asked.append(list(group))
        return len(asked) < 3

    said = witness().testify("", sent, ["q", "r"], fits)
    assert [len(group) for group in asked] == [AT_ONCE, AT_ONCE, 3]
    assert asked[0] == ["a", "b", "c", "", "d", "e", "q", "r"]
    assert (said.agents, said.unread) == (tuple(names), ("n", "o", "p"))
    read = [name not in said.unread for name in names]
    np.testing.assert_array_equal(said.maps[read], whole.maps[read])
    assert not said.maps[~np.array(read)].any()
    assert not said.over_ego[~np.array(read)].any()
    assert said.of(["a", "p"]).unread == ("p",)


def test_reading_pauses_between_groups(rng):
    sent = {name: messages(rng)["a"] for name in ["", *"bcdefghijklmnopqr"]}
    assert len(list(witness().testify_in_steps("", sent))) == math.ceil(len(sent) / AT_ONCE) - 1


def test_testimony_of_a_message_depends_on_no_other(rng):
    """Not even by rounding, whatever the others hold, and whoever is the ego."""
    sent = messages(rng)
    together = witness().testify("", sent)
    assert together.agents == NAMES
    assert together.maps.shape == (3, LAYERS, 64, 64)
    forged = Message(sent["b"].pose, {"map": 50 - sent["b"].tensors["map"]})
    beside = witness().testify("a", {**sent, "b": forged})
    alone = witness().testify("a", {"a": sent["a"]})
    np.testing.assert_array_equal(beside.maps[:2], together.maps[:2])
    np.testing.assert_allclose(alone.maps[0], together.maps[1], atol=2e-3)
    assert np.abs(beside.maps[2] - together.maps[2]).max() > 0.1


@pytest.mark.parametrize("size", [1e6, -1e6, 3e38])
def test_a_message_of_huge_values_is_read_as_numbers_and_costs_nobody_else(rng, size):
    sent = messages(rng)
    honest = witness().testify("", sent)
    huge = Message(sent["b"].pose, {"map": np.full((4, 16, 16), size, dtype=np.float32)})
    heard = witness().testify("", {**sent, "b": huge})
    assert np.isfinite(heard.maps).all()
    assert np.isfinite(heard.over_ego).all()
    sighting = heard.sighting(np.array([[3.0, 4.0], [-9.0, 1.0]]))
    assert np.isfinite(sighting.along).all()
    assert np.array_equal(heard.maps[:2], honest.maps[:2])
    assert np.array_equal(heard.over_ego[:2], honest.over_ego[:2])


def test_maps_are_read_alike_however_they_lie_in_memory():
    layout = Layout.of(INFO, 1.0)
    values = np.random.default_rng(0).normal(size=(4, 16, 16)).astype(np.float32)
    last = np.ascontiguousarray(values.transpose(1, 2, 0)).transpose(2, 0, 1)
    one, other = (layout.maps([Message(POSES[0], {"map": m})] * 2) for m in (values, last))
    assert one.stride() == other.stride()
    assert torch.equal(one, other)


def test_the_network_is_told_where_cells_are():
    geometry = Layout.of(INFO, 1.0).geometry([2.5, 5.0])
    assert geometry.shape == (2, GEOMETRY, 16, 16)
    east, north = geometry[0, :2, 3, 12] * 32
    assert (float(east), float(north)) == (18.0, -18.0)
    np.testing.assert_allclose(geometry[0, 2] ** 2, geometry[0, 0] ** 2 + geometry[0, 1] ** 2, rtol=1e-5)
    assert float(geometry[0, -1, 0, 0]) == 0.5


def test_a_height_above_the_sea_is_none_above_ground():
    told = Layout.of(INFO, 1.0).geometry([0.0, 1.7, 5.0, 12.0, 400.0, -3.0, math.nan])[:, -1, 0, 0] * 5
    np.testing.assert_allclose(told, [0.0, 1.7, 5.0, HIGHEST_M, USUAL_M, USUAL_M, USUAL_M], rtol=1e-6)


def test_what_is_read_is_divided_by_the_usual_size(rng):
    sent = messages(rng)
    double = {n: Message(m.pose, {"map": 2 * m.tensors["map"]}) for n, m in sent.items()}
    np.testing.assert_array_equal(
        witness(scale=2.0).testify("", sent).maps, witness(scale=4.0).testify("", double).maps
    )


def test_testimony_is_laid_over_the_egos_map(rng):
    """As `Testimony.likelihood` finds it at the same places, to the width of a place."""
    said = witness().testify("", messages(rng))
    places = said.ego_places()
    looked_up = said.likelihood(places.reshape(-1, 2)).reshape(3, 64, 64)
    inside = (np.abs(said.places(places.reshape(-1, 2))).max(axis=-1) < 31).reshape(3, 64, 64)
    for agent in range(3):
        np.testing.assert_allclose(said.over_ego[agent][inside[agent]], looked_up[agent][inside[agent]], atol=2e-3)
    assert inside.sum(axis=(1, 2)).min() > 1000
    assert (said.over_ego[1][~inside[1]] == 0).any()


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_message_that_is_the_same_around_a_place_shows_nothing_there(mirrored, rng):
    """It has cells of 4 m; what differs is one at x 8 to 12, y -20 to -16 of its sender's frame, and the rim."""
    sent = messages(rng)
    alone = np.repeat(rng.normal(size=(4, 1, 1)), 16, axis=1).repeat(16, axis=2).astype(np.float32)
    alone[:, 3, 10] += 1.0
    alone[:, 0], alone[..., -1] = 7.0, 7.0
    sent["b"] = Message(POSES[2], {"map": np.ascontiguousarray(alone[..., ::-1]) if mirrored else alone})
    testimony = witness(replace(INFO, mirrored=mirrored)).testify("", sent)
    places = np.array(
        [[10.0, -18.0], [6.5, -18.0], [10.0, -12.5], [3.5, -18.0], [10.0, -11.5], [29.0, -31.0], [90.0, 0.0]]
    )
    world_from_b = POSES[2] @ np.vstack([places.T, np.zeros(len(places)), np.ones(len(places))])
    in_ego = (np.linalg.inv(POSES[0]) @ world_from_b)[:2].T
    assert testimony.is_empty("b", in_ego).tolist() == [False, False, False, True, True, True, True]
    assert testimony.of(["", "b"]).is_empty("b", in_ego[2:4]).tolist() == [False, True]
    assert testimony.is_empty("a", np.array([[10.0, -5.0], [14.0, 2.0]])).tolist() == [False, False]
    assert replace(testimony, empty=None).is_empty("b", in_ego).tolist() == [False] * 7


def test_a_witness_survives_a_file(rng, tmp_path):
    learned, path = witness(scale=0.7), tmp_path / "x.witness.safetensors"
    before = Witness(learned.network.half().float(), learned.layout)  # as files hold it
    before.write(path, INFO, {"seed": 3})
    after = Witness.open(path, INFO)
    assert after.layout == before.layout
    sent = messages(rng)
    np.testing.assert_array_equal(after.testify("", sent).maps, before.testify("", sent).maps)


def test_a_witness_of_other_weights_or_messages_is_refused(tmp_path):
    path = tmp_path / "x.witness.safetensors"
    witness().write(path, INFO, {})
    with pytest.raises(WeightsError, match="belongs to weights with the digest dddddddddddd"):
        Witness.open(path, replace(INFO, weights_digest="e" * 64))
    wider = {"teammate": {"map": TensorSpec("float32", (5, 16, 16))}}
    with pytest.raises(WeightsError, match="does not fit the messages of fake"):
        Witness.open(path, replace(INFO, tensors=wider))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(WeightsError, match="not a readable"):
        Witness.open(path, INFO)
