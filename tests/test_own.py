"""A detector, a defence, an attack and a scene source of the user's own, as the pages on them have them, together."""

import csv
import io
import os
import re
import sys
from pathlib import Path

import httpx
import pytest
from rich.console import Console
from typer.testing import CliRunner

from clients.fleet import FleetOptions, run_fleet
from clients.local_gateway import local_gateway
from robosac.cli import app
from robosac.defenses.group_testing import Calibration

DOCS = Path(__file__).parents[1] / "docs"
PAGES = ("own-detector", "own-defense", "own-attack", "own-data")


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder on the path of Python with the examples of the pages."""
    for page in PAGES:
        text = (DOCS / f"{page}.md").read_text()
        example, name = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], re.findall(r"`(my_\w+\.py)`", text)[0]
        (tmp_path / name).write_text(example)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("my_")]:
        del sys.modules[name]


def robosac(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": "200"})


def said(done):
    """What a command complains of."""
    return " ".join(done.stderr.replace("│", "").split())


def test_all_four_are_compared(own):
    options = ["--detector", "my_detector:build", "--data", "my_data:Road", "--defense", "my_defense:RunningScore"]
    settings = ["--setting", "my_attack:Suppress:1", "--only", "one_by_one", "--scenes", 2, "--frames", 6, "--jobs", 2]
    done = robosac("compare", "--out", "out", *options, *settings)
    assert done.exit_code == 0, done.stderr
    with (own / "out" / "comparison.csv").open() as file:
        rows = {row["defense"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["oracle", "one_by_one", "my_defense:RunningScore", "ego only"]
    assert {row["campaign"] for row in rows.values()} == {"my_attack:Suppress"}
    assert float(rows["oracle"]["ap50"]) > float(rows["ego only"]["ap50"]) > 0


async def test_all_four_are_calibrated_served_and_driven(own, monkeypatch):
    options = ["--detector", "my_detector:build", "--data", "my_data:Road", "--pose-error", 0]
    attacks = ["--attack", "pgd", "--attack", "my_attack:Suppress", "--scenes", 8, "--check-scenes", 0]
    path = own / "my_detector.calibration.json"
    done = robosac("calibrate", *options, *attacks, "--out", path)
    assert done.exit_code == 0, done.stdout
    assert Calibration.read(path).recipe["data"] == "my_data:Road"
    monkeypatch.setenv("ROBOSAC_EXTRA_DETECTORS", "my_detector:build")
    monkeypatch.setenv("ROBOSAC_EXTRA_DEFENSES", "my_defense:RunningScore")
    shared = {"scenes": 1, "frames": 4, "first_scene": 0, "egos": 1, "attackers": 1, "seed": 0, "budget_ms": 20_000.0}
    chosen = {"attack": "my_attack:Suppress", "detector": "my_detector:build", "data": "my_data:Road"}
    console = Console(file=io.StringIO())
    async with local_gateway(own / "gateway.log") as url:
        async with httpx.AsyncClient(base_url=url, trust_env=False) as http:
            entries = {entry["name"]: entry for entry in (await http.get("/v1/detectors")).json()["detectors"]}
        calibration = entries["occupancy-max"]["calibration"]
        assert calibration["kinds"] == ["pgd", "my_attack:Suppress", "open"]
        assert calibration["pose_errors_m"] == [0.0]
        for defense, names in ((None, True), ({"kind": "running_score"}, False)):
            fleet = FleetOptions(url=url, defense=defense, real_time=False, report=None, **shared, **chosen)
            summary = await run_fleet(fleet, console)
            assert summary.frames == 4
            assert (summary.naming is not None) is names  # group testing where none is asked for


def test_data_can_be_disturbed_and_compared_with_itself(own):
    example = re.findall(r"```python\n(.*?)```", (DOCS / "own-data.md").read_text(), re.DOTALL)[1]
    (own / "my_worlds.py").write_text(example)
    worlds = ["--world", "my_data:Road", "--world", "my_worlds:WetRoad"]
    short = ["--setting", "honest:0", "--only", "no defence", "--scenes", 2, "--frames", 6]
    done = robosac("compare", *worlds, *short, "--out", "out")
    assert done.exit_code == 0, done.stderr
    with (own / "out" / "worlds.csv").open() as file:
        dry, wet = csv.DictReader(file)
    assert (dry["world"], wet["world"]) == ("my_data-Road", "my_worlds-WetRoad")
    assert dry["true_boxes"] == wet["true_boxes"]
    assert float(dry["oracle_ap70"]) > float(wet["oracle_ap70"]) > 0
    assert {path.name for path in (own / "out").iterdir()} == {
        *(line["world"] for line in (dry, wet)),
        "worlds.csv",
        "worlds.md",
    }


def test_what_cannot_be_is_said_before_the_work(own):
    shifting = robosac("calibrate", "--detector", "my_detector:build", "--data", "my_data:Road", "--out", "x.json")
    assert shifting.exit_code == 2
    assert "for --attack: invent cannot attack the detector occupancy-max: its attack surface lacks" in said(shifting)
    assert "It can be calibrated with the others: pgd, erase" in said(shifting)
    assert "frames" not in shifting.stdout
    one = ["--data", "my_data:Road", "--attack", "shift", "--out", "x.json"]
    assert "with the others" not in said(robosac("calibrate", "--detector", "my_detector:build", *one))
    few = ["--attack", "pgd", "--pose-error", 0, "--scenes", 2, "--check-scenes", 0, "--out", "x.json"]
    small = robosac("calibrate", "--detector", "my_detector:build", "--data", "my_data:Road", *few)
    assert small.exit_code == 2
    assert "for --scenes: 2 are too few" in said(small)
    assert "try 6" in said(small)
    quick = ["--quick", "--scenes", 1, "--frames", 6, "--only", "one_by_one", "--only", "group_testing"]
    asked = robosac("compare", "--detector", "my_detector:build", "--out", "out", *quick)
    assert asked.exit_code == 2
    assert "for --only: group_testing: the detector occupancy-max is not calibrated" in said(asked)
    short = ["--setting", "honest:0", "--scenes", 1, "--frames", 6, "--live"]
    rest = robosac("compare", "--detector", "my_detector:build", "--data", "my_data:Road", "--out", "out", *short)
    assert rest.exit_code == 0, rest.stderr
    assert "Left out: group_testing: the detector occupancy-max is not calibrated" in " ".join(rest.stdout.split())
    shifted = robosac("fleet", "--detector", "my_detector:build", "--data", "my_data:Road", "--attack", "shift")
    assert shifted.exit_code == 2
    assert "for --detector: shift cannot attack the detector occupancy-max" in said(shifted)
    many = robosac("evaluate", "--data", "my_data:Road", "--scenes", 1, "--collaborators", 3)
    assert "no 3 of 3 teammates can be free of 1 attackers" in said(many)
    assert not (own / "x.json").exists()
