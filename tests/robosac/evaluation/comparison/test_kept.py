"""A comparison that is stopped goes on from the sequences that are played."""

import errno
import os
import re
import sys
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.evaluation.comparison import DEFENSES, Extent, Plan, Setting, built, compare_defenses, kept, running
from tests.few import Few

NAMES = ("no defence", "group_testing, expecting .2 m")


class Stop(Exception):
    pass


@pytest.fixture(scope="module")
def whole(detector, tmp_path_factory):
    """A plan without a folder to keep its sequences in, and its rows."""
    extent = Extent((Setting("noise", 1), Setting("noise@turns", 2)), scenes=2, frames=6)
    defenses, _ = built({name: DEFENSES[name] for name in NAMES}, detector)
    plan = Plan(detector, defenses, extent, data=Few(), recordings=tmp_path_factory.mktemp("recordings"))
    return plan, compare_defenses(plan)


def stopped(plan, after):
    """Ticks until it was stopped after so many of them."""
    ticks = []

    def tick():
        if len(ticks) == after:
            raise Stop
        ticks.append(1)

    with pytest.raises(Stop):
        compare_defenses(plan, tick=tick)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_played_is_not_played_again_and_counts_the_same(whole, jobs, tmp_path, monkeypatch):
    plan, rows = whole
    plan = replace(plan, kept=tmp_path / "kept")
    assert kept.begin(plan) == 0
    stopped(plan, after=12 + 5)
    assert kept.begin(plan) == 1
    played, ticks = [], []
    play = running.play_scene

    def counted(plan, scene, tick):
        played.append(scene.number)
        return play(plan, scene, tick)

    monkeypatch.setattr(running, "play_scene", counted)
    assert compare_defenses(plan, jobs, lambda: ticks.append(1)) == rows
    assert len(ticks) == 24
    if jobs == 1:
        assert played == [plan.scenes()[1].number]
    assert kept.begin(plan) == 2
    assert compare_defenses(plan) == rows
    kept.end(plan)
    assert not plan.kept.exists()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"pose_error_m": 0.2, "live": True}, "pose error, live"),
        ({"extent": Extent((Setting("noise", 1),), scenes=2, frames=7)}, "settings, frames"),
        ({"defenses": {}}, "defenses"),
    ],
)
def test_sequences_of_another_comparison_are_not_mixed_in(whole, change, named, tmp_path):
    plan = replace(whole[0], kept=tmp_path / "kept")
    kept.begin(plan)
    kept.begin(replace(plan, **change))  # nothing is lost yet
    kept.begin(plan)
    stopped(plan, after=12)
    with pytest.raises(ValueError, match=f"that differs in {named}; choose another folder"):
        kept.begin(replace(plan, **change))
    more = replace(plan, extent=replace(plan.extent, scenes=3))
    assert kept.begin(more) == 1


def test_code_that_has_changed_plays_anew(whole, tmp_path, monkeypatch):
    plan = replace(whole[0], kept=tmp_path / "kept")
    kept.begin(plan)
    stopped(plan, after=12)
    monkeypatch.setattr(kept, "package_code", lambda: "another")
    with pytest.raises(ValueError, match="differs in code;"):
        kept.begin(plan)


def test_fewer_sequences_than_there_are_can_be_asked_for(whole, tmp_path):
    plan = replace(whole[0], kept=tmp_path / "kept")
    kept.begin(plan)
    compare_defenses(plan)
    assert kept.begin(replace(plan, extent=replace(plan.extent, scenes=1))) == 1


MINE = """
import torch
from robosac.attacks import Attack
from {helper} import STRENGTH

class Mine(Attack):
    name = "mine"

    def run(self, surface, attackers, rng, situation=None):
        return {{name: surface.messages[name] + STRENGTH for name in attackers}}
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The file that one's own attack takes its strength from, and the attack's name."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("kept_strength", "kept_mine"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "kept_strength.py").write_text("STRENGTH = 0.5\n")
    (tmp_path / "kept_mine.py").write_text(MINE.format(helper="kept_strength"))
    return tmp_path / "kept_strength.py", "kept_mine:Mine:1"


def compare(*arguments):
    return CliRunner().invoke(app, ["compare", *SHORT, *map(str, arguments)], env={"COLUMNS": "300"})


SHORT = ["--data", "tests.few:Few", "--only", "no defence", "--scenes", "2", "--frames", "6"]


def test_ones_own_code_counts_with_what_it_imports(own, tmp_path, monkeypatch):
    helper, attack = own
    play = running.play_scene

    def once(plan, scene, tick):
        if scene.number != 0:
            raise KeyboardInterrupt
        return play(plan, scene, tick)

    arguments = ["--setting", attack, "--live", "--out", tmp_path / "out"]
    with monkeypatch.context() as patched:
        patched.setattr(running, "play_scene", once)
        assert compare(*arguments).exit_code == 130
    helper.write_text("STRENGTH = 0.1\n")
    refused = compare(*arguments)
    assert refused.exit_code == 2
    assert "differs in code;" in refused.output
    helper.write_text("STRENGTH = 0.5\n")
    assert compare(*arguments).exit_code == 0


def test_a_full_disk_ends_it_in_a_line(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kept, "keep", full)
    ended = compare("--setting", "noise:1", "--live", "--out", tmp_path / "out")
    assert ended.exit_code == 1
    assert "Error: No space left on device" in ended.output


def test_what_other_code_recorded_is_not_used(own, tmp_path):
    helper, attack = own
    folder = tmp_path / "recordings"
    arguments = ["--setting", attack, "--recordings", folder, "--force", "--scenes", 1, "--out", tmp_path / "out"]
    files = []
    for strength in (0.5, 0.5, 0.1):
        helper.write_text(f"STRENGTH = {strength}\n")
        assert compare(*arguments).exit_code == 0
        files.append(len(list(folder.iterdir())))
    assert files[0] == files[1]
    assert files[2] == 2 * files[0]


def test_the_same_command_goes_on_and_leaves_the_report_alone(tmp_path, monkeypatch):
    short = ["--only", "no defence", "--setting", "noise:1", "--scenes", "2", "--frames", "6", "--live"]
    arguments = ["compare", *short, "--out", str(tmp_path)]
    play, played = running.play_scene, []

    def once(plan, scene, tick):
        if len(played) == 1:
            played.append(scene)
            raise KeyboardInterrupt
        played.append(scene)
        return play(plan, scene, tick)

    monkeypatch.setattr(running, "play_scene", once)
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 130, first.output
    assert "The same command goes on" in first.output
    assert [path.name for path in tmp_path.iterdir()] == ["unfinished"]
    other = CliRunner().invoke(app, [*arguments, "--seed", "1"], env={"COLUMNS": "300"})
    assert other.exit_code == 2
    assert re.search(r"--out.*differs in seed", other.output, re.S)
    second = CliRunner().invoke(app, arguments)
    assert second.exit_code == 0, second.output
    assert "Going on: 1 of 2 sequences were played before" in second.output
    assert len(played) == 3
    assert not (tmp_path / "unfinished").exists()
    assert (tmp_path / "comparison.md").exists()
