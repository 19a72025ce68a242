"""What suspicion is worth, where the likelihoods were counted and in other worlds."""

import json
import shutil
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from robosac.calibrated import calibration_of
from robosac.calibration.reliability import Reliability, ReliabilityBin, check, check_in
from robosac.cli import app
from robosac.defenses import GroupTesting
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.scenes import SOURCES, WORLDS
from tests.robosac.calibration.test_calibration import recorded
from tests.robosac.defenses.group_testing.conversing import make_model

SHIPPED = SHIPPED_WEIGHTS.with_suffix(".calibration.json")


@pytest.fixture(scope="module")
def quick(tmp_path_factory, detector):
    """The shipped calibration as if made with noise alone, which takes no time to make."""
    path = tmp_path_factory.mktemp("calibration") / "x.calibration.json"
    content = json.loads(SHIPPED.read_text())
    content["recipe"].update(attacks=["noise"], attackers=[2], scenes=1)
    path.write_text(json.dumps(content))
    return path


def test_reliability_compares_suspicion_with_the_truth():
    stretches = [(None, [recorded()]), ("pgd", [recorded(["a"])]), ("pgd", [recorded(["b", "c"])])] * 4
    bins = check(GroupTesting(make_model()), stretches)
    assert sum(b.teammates for b in bins) == 36
    assert bins[0].observed == 0.0
    assert bins[-1].observed == 1.0
    assert all(b.low <= b.predicted <= b.high for b in bins)


def test_the_error_weighs_bins_by_their_teammates():
    bins = (ReliabilityBin(0, 0.5, 3, 0.1, 0.0), ReliabilityBin(0.5, 1, 1, 0.9, 0.5))
    assert Reliability(1, 4, 0, 0, 0, bins).error == pytest.approx((3 * 0.1 + 0.4) / 4)


def test_a_world_is_checked_on_scenes_that_were_not_fitted_to(detector):
    calibration = calibration_of(detector.info)
    recipe = {**calibration.recipe, "attacks": ["noise"], "attackers": [2], "scenes": 3}
    seen = []

    class Watched:
        def __init__(self, source):
            self.name, self.source = source.name, source

        def scenes(self, split):
            return [seen.append((split, scene.number)) or scene for scene in self.source.scenes(split)[:5]]

    source = SOURCES.make("world:highway")
    found = check_in(detector, replace(calibration, recipe=recipe), Watched(source), 1)
    assert {split for split, _ in seen} == {"validation"}
    assert (found.scenes, found.attackers, found.honest) == (1, 2, sum(b.teammates for b in found.bins) - 2)
    fitted = check_in(detector, replace(calibration, recipe={**recipe, "scenes": 0}), source, 1)
    assert fitted.bins != found.bins


def test_the_command_adds_worlds_to_a_calibration_and_keeps_the_rest(quick, tmp_path):
    path = tmp_path / "x.calibration.json"
    shutil.copy(quick, path)
    only = ["calibrate", "--worlds-only", "--check-scenes", "1", "--out", str(path)]
    for world in ("highway", "car-park"):
        result = CliRunner().invoke(app, [*only, "--world", world])
        assert result.exit_code == 0, result.output
        assert world in result.output
    before, after = json.loads(quick.read_text()), json.loads(path.read_text())
    worlds = after.pop("worlds")
    before.pop("worlds", None)
    assert after == before
    assert {"highway", "car-park"} <= set(worlds)
    assert "--world highway" in worlds["highway"]["command"]
    assert worlds["highway"]["honest"] + worlds["highway"]["attackers"] == 10
    assert sum(each["teammates"] for each in worlds["highway"]["bins"]) == 10


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--worlds-only"], "--world"),
        (["--worlds-only", "--messages-only", "--world", "highway"], "give one of them"),
        (["--worlds-only", "--world", "nowhere"], "nowhere"),
        (["--worlds-only", "--world", "highway", "--out", "none.json"], "none.json cannot be read: No such file"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(quick, arguments, words):
    result = CliRunner().invoke(app, ["calibrate", "--out", str(quick), *arguments])
    assert result.exit_code == 2
    assert words in " ".join(result.output.replace("│", " ").split())


def test_the_shipped_calibration_says_what_it_is_worth_elsewhere():
    worlds = json.loads(SHIPPED.read_text())["worlds"]
    assert set(worlds) == set(WORLDS)
    for each in worlds.values():
        assert sum(b["teammates"] for b in each["bins"]) == each["honest"] + each["attackers"]
        share = each["honest_suspected"] / each["honest"]
        assert share < 0.1
        assert each["attackers_suspected"] / each["attackers"] > 5 * share
