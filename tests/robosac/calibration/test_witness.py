"""A witness learns a world in which everything observed is plain to see."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from robosac.calibration.places import OBSERVED_HITS, Places
from robosac.calibration.witness import (
    Lesson,
    WitnessRecipe,
    _partly_blocked,
    lessons,
    train,
    training_scenes,
    usual_size,
)
from robosac.calibration.witness_check import check
from robosac.cli import app
from robosac.detectors import DetectorInfo, Message, TensorSpec, load
from robosac.detectors.witness import Witness
from robosac.detectors.witness_network import Layout, WitnessNetwork
from robosac.scenes import IntersectionScene, SceneError, View
from robosac.scenes.base import SceneAround
from robosac.scenes.intersection import Synthetic

CELLS, HALF_EXTENT_M = 12, 12.0  # cells of 2 m
RECIPE = WitnessRecipe(epochs=15, batch=8, learning_rate=1e-2, seed=1)


def layout(mirrored=False):
    tensors = {"teammate": {"map": TensorSpec("float16", (3, CELLS, CELLS))}}
    area = (-HALF_EXTENT_M, -HALF_EXTENT_M, HALF_EXTENT_M, HALF_EXTENT_M)
    return Layout.of(DetectorInfo("plain", tensors, area, 2.0, "0", 0.5, mirrored=mirrored), 1.0)


def lesson(rng, mirrored=False):
    """A few vehicles, and three times as many free places. In the half ahead, the map shows all vehicles."""
    at = rng.uniform(-10.5, 10.5, (60, 2))
    apart = []
    for place in at:
        if all(np.abs(place - other).max() > 4.2 for other in apart):
            apart.append(place)
    at = np.array(apart)
    vehicle = (np.arange(len(at)) < len(at) // 4).astype(float)
    hits = np.where(at[:, 0] > 0, 40.0, 0.0)
    centres = np.arange(CELLS) * 2.0 - HALF_EXTENT_M + 1
    x, y = np.meshgrid(centres, centres)
    shown = np.zeros((3, CELLS, CELLS))
    shown[1] = x > 0
    for px, py in at[(vehicle > 0) & (hits > 0)]:
        near = (np.abs(x - px) < 2) & (np.abs(y - py) < 2)
        shown[0][near], shown[2][near] = (x - px)[near] + 3, (y - py)[near] + 3
    box = np.where(vehicle[:, None] > 0, np.column_stack([at, np.tile([4.5, 1.9, 0.0], (len(at), 1))]), 0.0)
    sent = torch.from_numpy(shown[..., ::-1].copy() if mirrored else shown).half()
    return Lesson(sent, 1.6, Places(at, vehicle, hits, box))


def world(seed, count, **options):
    rng = np.random.default_rng(seed)
    return [lesson(rng, **options) for _ in range(count)]


@pytest.fixture(scope="module")
def trained():
    told = []
    witness = train(layout(), world(1, 120), RECIPE, lambda *step: told.append(step))
    return witness, told


def test_a_plain_world_is_learned(trained):
    witness, told = trained
    figures = check(witness, world(2, 40))
    assert figures.places > 200
    assert figures.vehicles_supported > 0.9
    assert figures.free_denied > 0.6
    assert figures.vehicles_denied < 0.02
    assert figures.free_supported < 0.05
    assert max(figures.off_along_m, figures.off_across_m) < 0.5
    assert [step for step, _, _ in told] == list(range(1, 15 * 15 + 1))
    assert told[-1][2] < 0.5 * told[0][2]


def test_an_untrained_witness_knows_nothing():
    torch.manual_seed(0)
    here = layout()
    figures = check(Witness(WitnessNetwork(here.channels, here.upsampling), here), world(2, 10))
    assert figures.vehicles_supported < 0.5
    assert figures.free_denied < 0.5


def test_where_nothing_is_observed_nothing_is_said(trained):
    """Although most such places are free: vehicles and free places weigh the same in total."""
    witness, _ = trained
    said = [(said_of(witness, each), each.places.hits >= OBSERVED_HITS) for each in world(3, 40)]
    unobserved = np.concatenate([likelihood[~seen] for likelihood, seen in said])
    observed = np.concatenate([likelihood[seen] for likelihood, seen in said])
    assert abs(np.median(unobserved)) < 0.5
    assert np.median(np.abs(unobserved)) < 1.0
    assert np.median(np.abs(observed)) > 3.0


def said_of(witness, each):
    message = witness.layout.scaled(each.map[None].float())
    maps = witness.read(message, [each.height_m]).numpy()[0, 0]
    column, row = ((each.places.at + HALF_EXTENT_M) / (2 * HALF_EXTENT_M) * maps.shape[0]).astype(int).T
    return maps[row, column]


def test_mirrored_maps_are_learned_alike():
    short = replace(RECIPE, epochs=1)
    plain = train(layout(), world(1, 16), short, lambda *_: None)
    mirrored = train(layout(mirrored=True), world(1, 16, mirrored=True), short, lambda *_: None)
    for name, values in plain.network.state_dict().items():
        assert torch.equal(mirrored.network.state_dict()[name], values)


def test_the_same_seed_trains_the_same_witness(trained):
    short = replace(RECIPE, epochs=1)
    one, again, other = (
        train(layout(), world(1, 16), r, lambda *_: None) for r in (short, short, replace(short, seed=2))
    )
    weights = [witness.network.state_dict()["head.weight"] for witness in (one, again, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


class Kept:
    """A source with scenes for validation only, or for training, too."""

    name = "kept"

    def __init__(self, training=None):
        if training is not None:
            self.training_scenes = lambda: training

    def scenes(self, split):
        assert split == "validation"
        return [0, 1, 2, 3]


def test_scenes_are_those_kept_for_training_or_the_last_ones_of_validation():
    assert training_scenes(Kept(), 2) == [2, 3]
    assert training_scenes(Kept([7, 8, 9]), 2) == [7, 8]
    with pytest.raises(SceneError, match="kept has too few scenes to train on: 4, and 5 are wanted"):
        training_scenes(Kept(), 5)


def test_lessons_are_all_agents_messages_and_what_is_there(detector):
    scene, ticks = IntersectionScene(1600), []
    size = usual_size(detector, scene)
    here = Layout.of(detector.info, size)
    recipe = replace(RECIPE, frames_per_scene=2)
    learned = lessons(detector, here, [scene], recipe, lambda: ticks.append(1))
    assert (len(learned), len(ticks)) == (2 * len(scene.frame(0).views), 2)
    assert all(each.map.shape == (here.channels, here.height, here.width) for each in learned)
    assert {round(each.height_m, 2) for each in learned} == {
        round(float(view.pose[2, 3]), 2) for view in scene.frame(0).views.values()
    }
    scaled = torch.stack([here.scaled(each.map.float()) for each in learned])
    assert 0.5 < float(scaled.pow(2).mean().sqrt()) < 2.0


class Blind(Synthetic):
    """Scenes in which no scan has a return."""

    name = "blind"

    def training_scenes(self):
        return [BlindScene(scene) for scene in super().training_scenes()]


class BlindScene(SceneAround):
    def frame(self, index):
        frame = self.scene.frame(index)
        views = {name: replace(view, points=view.points[:0]) for name, view in frame.views.items()}
        return SimpleNamespace(index=index, views=views, truth=frame.truth)


def test_scans_without_returns_make_no_witness(tmp_path):
    out, data = tmp_path / "x.safetensors", f"{__name__}:Blind"
    short = ["--scenes", "1", "--check-scenes", "1", "--frames", "1", "--epochs", "1"]
    result = CliRunner().invoke(app, ["witness", "--out", str(out), "--data", data, *short], env={"COLUMNS": "200"})
    assert result.exit_code == 2, result.output
    assert "Invalid value for --data: no vehicle has 6 returns in any of 6 scans: a witness needs some" in result.output
    assert not out.exists()


@pytest.mark.parametrize(
    "settings", [{"data": ()}, *({name: 0} for name in ("scenes", "epochs", "batch", "frames_per_scene"))]
)
def test_recipes_that_cannot_be(settings):
    with pytest.raises(ValueError, match="must be at least 1"):
        WitnessRecipe(**settings)


@pytest.mark.parametrize("seed", range(6))
def test_a_partly_blocked_scan_lacks_one_sector(seed):
    azimuth = np.linspace(-np.pi, np.pi, 3601)[:-1]
    scan = View(np.eye(4), np.column_stack([9 * np.cos(azimuth), 9 * np.sin(azimuth), np.zeros_like(azimuth)]))
    left = _partly_blocked(scan, np.random.default_rng(seed)).points
    there = np.isin(scan.points[:, 0] + 100 * scan.points[:, 1], left[:, 0] + 100 * left[:, 1])
    assert np.pi / 6 - 0.01 < 2 * np.pi * (1 - there.mean()) < 2 * np.pi
    assert (np.diff(there.astype(int), append=int(there[0])) != 0).sum() == 2


def test_a_recorded_message_is_not_blocked():
    view = IntersectionScene(1600).frame(0).views["rsu"]
    recorded = View(view.pose, view.points, message=Message(view.pose, {}))
    assert _partly_blocked(recorded, np.random.default_rng(0)) is recorded


def test_a_part_of_the_scans_to_learn_from_is_blocked(monkeypatch):
    detector, scene = load(), IntersectionScene(1600)
    layout, recipe = Layout.of(detector.info, 1.0), WitnessRecipe(frames_per_scene=2)
    whole = {}
    for share in (0.0, 1.0):
        monkeypatch.setattr("robosac.calibration.witness.BLOCKED_SHARE", share)
        whole[share] = lessons(detector, layout, [scene], recipe, lambda: None)
    assert all((a.map != b.map).any() for a, b in zip(whole[0.0], whole[1.0], strict=True))
    hits = {share: np.concatenate([lesson.places.hits for lesson in of]) for share, of in whole.items()}
    assert (hits[1.0] == 0).mean() > (hits[0.0] == 0).mean() + 0.1
