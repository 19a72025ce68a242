import csv
from importlib.metadata import version

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.cli.options import load_worlds
from robosac.defenses import Undefended
from robosac.evaluation.comparison import Extent, Plan, Setting, compare_defenses, compare_plans, write_worlds
from robosac.evaluation.comparison.playing import attackers
from robosac.evaluation.comparison.settings import NOBODY
from robosac.scenes import WORLDS, World
from tests.robosac.evaluation.comparison.test_comparison import Accuser

NAMES = ("crossing-dropped", "highway")
SHORT = ["--setting", "honest:0", "--setting", "noise:1", "--scenes", "2", "--frames", "6"]


def run(*arguments):
    return CliRunner().invoke(app, ["compare", *arguments], env={"COLUMNS": "200"})


def read(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """What `compare` writes about two worlds, two processes sharing them."""
    folder = tmp_path_factory.mktemp("worlds")
    worlds = [word for name in NAMES for word in ("--world", name)]
    only = ["--only", "no defence", "--only", "sample_consensus", "--only", "group_testing"]
    result = run(*worlds, *only, *SHORT, "--jobs", "2", "--out", str(folder))
    assert result.exit_code == 0, result.output
    return folder


def test_each_world_has_its_report_and_all_have_one(out):
    assert sorted(path.name for path in out.iterdir()) == [*NAMES, "worlds.csv", "worlds.md"]
    for name in NAMES:
        text = (out / name / "comparison.md").read_text()
        assert f"--world {NAMES[0]} --world {NAMES[1]}" in text
        assert "| noise x 1 |" in text
    page = (out / "worlds.md").read_text()
    assert "2 test sequences of 6 frames in each world" in page
    assert f"Made by robosac {version('robosac')} with seed 0" in page
    for title in ("## nobody attacks", "## noise x 1"):
        assert title in page
    assert page.count("| highway | group_testing | ") == 2
    assert "| true boxes contradicted, of 1000 | true boxes confirmed |" in page
    assert "| true boxes contradicted, of 1000 | true boxes confirmed |" in (out / "highway/comparison.md").read_text()


def test_a_line_says_what_the_world_s_report_says(out):
    lines = read(out / "worlds.csv")
    assert len(lines) == len(NAMES) * 2 * 3
    for line in lines:
        report = {(row["campaign"], row["defense"]): row for row in read(out / line["world"] / "comparison.csv")}
        row, campaign = report[line["campaign"], line["defense"]], line["campaign"]
        for whose, of in (("oracle", "oracle"), ("undefended", "no defence"), ("ego_only", "ego only")):
            assert line[f"{whose}_ap70"] == report[campaign, of]["ap70"]
        assert line["own_ap50"] == row["ap50"]
        assert float(line["ap70_lost"]) == pytest.approx(-float(row["ap70_difference"]), abs=2e-5)
        assert line["ap70_lost_se"] == row["ap70_difference_se"] != ""
        assert float(line["honest_refused"]) == float(row["honest_refused"])
        assert line["honest_named"] == row["honest_named"]
        assert line["sequences"] == "2"
        for name in ("true_confirmed", "true_contradicted", "true_confirmed_se"):
            assert line[name] == row[name]
            assert bool(line[name]) is line["defense"].startswith("group")
        assert bool(line["sequences_honest_named"]) is line["defense"].startswith("group")


def test_a_world_is_played_as_it_is_by_itself(out, tmp_path):
    result = run("--data", "world:highway", "--only", "sample_consensus", *SHORT, "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    alone = [row for row in read(tmp_path / "comparison.csv") if row["defense"] == "sample_consensus"]
    among = [row for row in read(out / "highway" / "comparison.csv") if row["defense"] == "sample_consensus"]
    assert alone == among


def test_true_boxes_and_wrong_names_are_counted_by_sequence(detector, tmp_path):
    extent, park = Extent((NOBODY, Setting("noise", 1)), scenes=3, frames=6), World("car-park")
    (first,) = attackers(park.scene(0), 1, seed=0)
    defenses = {"no defence": Undefended(), "a": Accuser(accused=(first,))}
    plan = Plan(detector, defenses, extent, live=True, data=park)
    wrongly = sum(first not in attackers(scene, 1, seed=0) for scene in plan.scenes())
    assert wrongly in (1, 2)
    (rows,) = compare_plans([plan])
    truth = [len(s.frame(i).truth("car-1")) for s in plan.scenes() for i in range(6)]
    assert all(row.true_boxes == pytest.approx(np.mean(truth)) for row in rows)
    quiet, noisy = (row for row in rows if row.defense == "a")
    assert (quiet.naming.sequences_honest_named, quiet.sequences, quiet.naming.honest_named) == (3, 3, 3)
    assert (
        noisy.naming.sequences_honest_named == noisy.naming.honest_named == wrongly
    )  # where it attacks it is named rightly
    write_worlds({"mine": rows}, {"mine": plan}, tmp_path, "the command")
    assert f"| mine | a | {np.mean(truth):.1f} | " in (tmp_path / "worlds.md").read_text()
    assert "| 3 of 15 | 3 of 3 | 0.00 / 0.00 | - | - |" in (tmp_path / "worlds.md").read_text()


def test_several_comparisons_are_each_as_by_itself(detector):
    extent = Extent((NOBODY,), scenes=1, frames=6)
    plans = [Plan(detector, {"no defence": Undefended()}, extent, data=World(name)) for name in NAMES]
    ticks = []
    assert compare_plans(plans, tick=lambda: ticks.append(1)) == [compare_defenses(plan) for plan in plans]
    assert len(ticks) == 12


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--world", "nonesuch"], f"no world 'nonesuch': there are {', '.join(WORLDS)}"),
        (["--world", "highway", "--data", "world:car-park"], "--data does, too"),
        (["--world", "no.such:module"], "no.such:module: ModuleNotFoundError"),
        (["--world", "v2x-sim:a/b", "--world", "v2x-sim:a-b"], "two of them would have the same folder"),
        (["--world", "highway", "--setting", "noise:6"], "noise:6: a scene of world:highway has 5 teammates"),
    ],
)
def test_worlds_that_make_no_sense_are_refused(arguments, complaint, tmp_path):
    result = run(*arguments, "--only", "no defence", "--out", str(tmp_path))
    assert result.exit_code == 2
    assert complaint in " ".join(result.output.replace("│", " ").split())


def test_all_asks_for_every_world(tmp_path):
    result = run(
        "--world", "all", "--only", "no defence", "--setting", "noise:6", "--scenes", "1", "--out", str(tmp_path)
    )
    assert result.exit_code == 2
    assert "noise:6: a scene of world:crossing has 5 teammates" in result.output
    asked = load_worlds(["highway", "all", "highway"])
    assert list(asked) == ["highway", *(name for name in WORLDS if name != "highway")]
