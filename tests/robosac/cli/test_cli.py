import json
import sys

import pytest
from typer.testing import CliRunner

from robosac.cli import app

runner = CliRunner()


def test_scene_draws_a_picture(tmp_path):
    out = tmp_path / "x.png"
    result = runner.invoke(app, ["scene", "--seed", "8", "--frame", "0", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "car-1 sees" in result.output


def test_evaluate_prints_and_writes_the_table(tmp_path):
    result = runner.invoke(app, ["evaluate", "--scenes", "1", "--frames", "1", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "Algorithm 1, N = 7" in result.output
    assert "false alarms" in result.output
    report = json.loads((tmp_path / "bounds.json").read_text())
    assert report["frames"] == 1
    assert {row["name"] for row in report["rows"]} >= {"all benign", "ego only", "no defence"}


def test_figures_are_whole_on_a_narrow_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    result = runner.invoke(app, ["evaluate", "--scenes", "1", "--frames", "1", "--attack", "noise"])
    assert result.exit_code == 0, result.output
    assert "…" not in result.output
    assert "infiltrated" in result.output


def test_reproduce_runs_what_is_asked_for(tmp_path):
    result = runner.invoke(app, ["reproduce", "--only", "numerical", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "report.md").read_text()
    assert "--only numerical" in text
    assert "## Numerical figures" in text
    assert (tmp_path / "numerical.png").exists()


def test_the_version_is_told():
    assert runner.invoke(app, ["--version"]).output.strip()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["scene", "--out", "x.png", "--agent", "car-9"], "known: car-1"),
        (["scene", "--out", "x.nonsense"], "nonsense"),
        (["scene", "--out", "x.png", "--seed", "-1"], "--seed"),
        (["evaluate", "--attack", "nonesuch"], "no attack 'nonesuch'"),
        (["evaluate", "--attackers", "3", "--collaborators", "3"], "free of 3 attackers"),
        (["evaluate", "--weights", "/nowhere"], "there is no file /nowhere"),
        (["evaluate", "--weights", "."], "is a folder; a weights file is wanted"),
        (["evaluate", "--detector", "nonesuch:build"], "No module named 'nonesuch'"),
        (["evaluate", "--scenes", "1001"], "1000 test scenes; 1001 are wanted"),
        (["evaluate", "--data", "."], "no scene source '.': give one of synthetic, world:NAME, "),
        (["reproduce", "--out", "x", "--only", "nonesuch"], "known: derivation"),
        (["train", "--out", "x", "--adversarial", "nonesuch"], "known: pgd"),
        (["compare", "--out", "x", "--pose-error", "inf"], "'--pose-error'"),
        (["show", "frame", "--out", "x.png", "--pose-error", "inf"], "'--pose-error'"),
        (["calibrate", "--out", "x.json", "--pose-error", "inf"], "'--pose-error'"),
        (["fleet", "--seed", "-1"], "'--seed'"),
        (["train", "--out", "x", "--seed", "-1"], "'--seed'"),
        (["witness", "--out", "x.safetensors", "--seed", "99999999999999999999"], "'--seed'"),
        (["load-test", "--seconds", "inf"], "'--seconds'"),
        (["load-test", "--rate", "inf"], "'--rate'"),
        (["overload", "--factor", "inf"], "'--factor'"),
        (["flood", "--rate", "inf"], "'--rate'"),
        (["nonesuch"], "No such command"),
    ],
)
def test_bad_arguments_are_explained(arguments, complaint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, arguments)
    assert result.exit_code == 2
    assert complaint in " ".join(result.output.replace("│", "").split())


@pytest.mark.parametrize(
    ("words", "option", "why"),
    [
        (["evaluate", "--attackers", "6"], "--attackers", "a scene has at most 5 teammates, not 6"),
        (["compare", "--setting", "pgd:9", "--out", "x"], "--setting", "pgd:9: a scene of synthetic has 5 teammates"),
        (["show", "frame", "--scene", "5000", "--out", "x.png"], "--scene", "synthetic has 1000 test scenes"),
    ],
)
def test_the_option_that_is_to_blame_is_named(words, option, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, words)
    assert result.exit_code == 2
    said = " ".join(result.output.replace("│", "").split())
    assert f"for {option}: {why}" in said
    assert not list(tmp_path.iterdir())


OWN = """
from types import SimpleNamespace
from typing import Literal
from robosac.attacks import Attack
from robosac.defenses import OneByOne
from robosac.detectors import load

class Failing(Attack):
    name = "failing"
    def run(self, surface, attackers, rng, situation=None):
        return surface.messages["car-99"]

class Silent(OneByOne):
    kind: Literal["silent"] = "silent"
    def converse(self, team, state, rng):
        yield []

class Another(OneByOne):
    kind: Literal["halving"] = "halving"

class Forgetful(OneByOne):
    kind: Literal["forgetful"] = "forgetful"
    def initial_state(self, team):
        pass

def unprepared():
    shipped = load("intersection-mean")
    return SimpleNamespace(info=shipped.info, encode=shipped.encode, prepare=lambda ego, teammates: None)
"""
FEW = ["--scenes", "1", "--frames", "6", "--only", "halving", "--setting", "noise:1", "--out", "x"]


@pytest.mark.parametrize(
    ("words", "code", "why"),
    [
        (["evaluate", "--attack", "own:Failing"], 1, "Error: own.py, line 11: KeyError: 'car-99'"),
        (
            ["compare", *FEW, "--defense", "own:Silent"],
            1,
            "own:Silent, frame 0: TypeError: silent: converse must",
        ),
        (["compare", *FEW, "--defense", "own:Forgetful"], 1, "Error: forgetful: initial_state must return a dict"),
        (["compare", *FEW, "--defense", "own:Another"], 2, "own:Another: there is another defence of kind 'halving'"),
        (["evaluate", "--detector", "own:unprepared"], 2, "prepare must return a frame to detect in, got a NoneType"),
    ],
)
def test_what_fails_in_the_users_code_is_told_in_a_line(words, code, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own", raising=False)
    (tmp_path / "own.py").write_text(OWN)
    result = runner.invoke(app, words)
    assert result.exit_code == code, result.output
    assert why in " ".join(result.output.replace("│", "").split())
