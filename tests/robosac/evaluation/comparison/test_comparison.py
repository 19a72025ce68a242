import csv

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from robosac.answers import Reason, Source
from robosac.attacks import load_campaign
from robosac.cli import app
from robosac.defenses import Decision, OneByOne, Rejection, SampleConsensus, Undefended
from robosac.evaluation.comparison import (
    DEFENSES,
    FULL,
    QUICK,
    Extent,
    Plan,
    Setting,
    built,
    compare_defenses,
    write_comparison,
)
from robosac.evaluation.comparison.pictures import TableError, read_table
from robosac.evaluation.comparison.rows import NamingFigures
from robosac.evaluation.comparison.settings import NOBODY
from robosac.evaluation.playing import FaultyDefense
from tests.few import Few

ERASED = Setting("erase", 1)
LATE = Setting("noise@asleep", 2)


class Accuser(Undefended):
    """Answers alone and names a fixed set of teammates from a frame on."""

    accused: tuple[str, ...] = ()
    patience: int = 2

    def initial_state(self, team):
        return {"frames": 0, "named": []}

    def converse(self, team, state, rng):
        yield from ()
        frames = state["frames"] + 1
        named = list(self.accused) if frames > self.patience else []
        rejected = {name: Rejection(Reason.NOT_SAMPLED) for name in team}
        return Decision((), Source.EGO_ONLY, rejected, None, {"frames": frames, "named": named})


class Broken(Undefended):
    def converse(self, team, state, rng):
        yield from ()
        raise RuntimeError("broken")


SMALL = Extent((NOBODY, ERASED), scenes=1, frames=6)
TRIO = {"no defence": Undefended(), "one_by_one": OneByOne(), "sampling": SampleConsensus()}


@pytest.fixture(scope="module")
def plan(detector, tmp_path_factory):
    """Make a plan; recordings are shared."""
    folder = tmp_path_factory.mktemp("recordings")

    def make(defenses, extent):
        return Plan(detector, defenses, extent, data=Few(), recordings=folder)

    return make


@pytest.fixture(scope="module")
def rows(plan):
    ticks = []
    rows = compare_defenses(plan(TRIO, SMALL), tick=lambda: ticks.append(1))
    assert len(ticks) == 12
    return rows


def test_every_defence_meets_every_setting_between_oracle_and_ego_alone(rows):
    names = ["oracle", "no defence", "one_by_one", "sampling", "ego only"]
    assert [(row.setting, row.defense) for row in rows] == [(s, n) for s in (NOBODY, ERASED) for n in names]


def test_what_was_answered_is_scored(rows):
    at = {(row.setting, row.defense): row for row in rows}
    quiet, ideal = at[NOBODY, "no defence"], at[NOBODY, "oracle"]
    assert (quiet.windows, quiet.whole.infiltrated, quiet.honest_refused) == (ideal.windows, 0.0, 0.0)
    erased, ideal = at[ERASED, "no defence"].whole, at[ERASED, "oracle"].whole
    assert erased.ap70.value < ideal.ap70.value - 0.05
    assert (erased.infiltrated, ideal.infiltrated) == (1.0, 0.0)
    assert ideal.ap70_ratio.value == 1.0
    alone = at[ERASED, "ego only"]
    assert (alone.whole.ap50, alone.honest_refused) == (at[NOBODY, "ego only"].whole.ap50, 1.0)


def test_fused_passes_are_counted_for_each_defence_by_itself(rows):
    at = {(row.setting, row.defense): row for row in rows}

    def passes(name):
        row = at[NOBODY, name]
        return row.passes_first, row.passes_early, row.passes_steady

    assert passes("oracle") == passes("no defence") == passes("sampling") == (1.0, 1.0, 1.0)
    assert passes("one_by_one") == (4.0, 4.0, 4.0)
    assert passes("ego only") == (0.0, 0.0, 0.0)


def test_a_row_depends_on_nothing_else_that_is_compared(rows, detector):
    alone = compare_defenses(Plan(detector, {"sampling": SampleConsensus()}, Extent((ERASED,), 1, 6), data=Few()))
    assert alone == [row for row in rows if row.setting == ERASED and row.defense in ("oracle", "sampling", "ego only")]


def test_who_names_whom_and_when(plan):
    late = Extent((Setting("noise@asleep", 1),), scenes=1, frames=13)  # strikes in frames 10, 11 and 12
    assert [row.naming for row in compare_defenses(plan({"mute": Undefended()}, late))] == [None] * 3
    team = ("car-2", "car-3", "rsu")
    accusers = {
        "everybody": Accuser(accused=team, patience=11),  # from frame 11 on, the second strike
        "at once": Accuser(accused=team, patience=0),
        "nobody": Accuser(),
    }
    at = {row.defense: row.naming for row in compare_defenses(plan(accusers, late))}
    assert at["everybody"] == NamingFigures(1.0, 2.0, 1, 1, 2.0, 2, 2, 2, 1, 1)
    assert (at["at once"].frames_to_name, at["at once"].frames_to_name_each) == (1.0, 1.0)
    assert at["nobody"] == NamingFigures(0.0, None, 0, 1, None, None, 0, 2, 0, 1)
    quiet = Extent((NOBODY,), scenes=1, frames=6)
    (_, calm, _) = compare_defenses(plan({"a": Accuser(accused=team[:2])}, quiet))
    assert calm.naming == NamingFigures(None, None, 0, 0, None, None, 2, 3, 1, 1)


def test_a_sleeping_attacker_counts_as_honest_until_it_strikes(plan):
    rows = compare_defenses(plan({"no defence": Undefended()}, Extent((LATE,), scenes=1, frames=11)))
    at = {row.defense: row for row in rows}
    infiltrated = {first: figures.infiltrated for first, figures in at["no defence"].windows.items()}
    assert infiltrated == {0: pytest.approx(1 / 11), 5: pytest.approx(1 / 6), 10: 1.0}
    assert at["ego only"].honest_refused == 1.0


def test_a_defence_that_fails_stops_the_comparison(plan):
    with pytest.raises(FaultyDefense, match="worse, frame 0: RuntimeError: broken"):
        compare_defenses(plan({"worse": Broken()}, SMALL))


def test_the_report_holds_tables_and_pictures(rows, plan, tmp_path):
    path = write_comparison(rows, plan(TRIO, SMALL), tmp_path, "the command")
    text = path.read_text()
    assert "`the command`: 1 test sequences of 6 frames" in text
    assert (
        f"with seed 0; intersection-mean: weights {plan(TRIO, SMALL).detector.info.weights_digest[:12]} and cal" in text
    )
    assert "| nobody attacks | " in text
    assert "| erase x 1 | " in text
    assert "## What it costs when nobody attacks" in text
    assert "Naming" not in text
    for picture in ("precision.png", "passes.png"):
        assert f"]({picture})" in text
        assert imread(tmp_path / picture).std() > 0.01
    with (tmp_path / "comparison.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        assert (line["campaign"], int(line["attackers"]), line["defense"]) == (
            row.setting.campaign,
            row.setting.attackers,
            row.defense,
        )
        assert float(line["ap70"]) == round(row.whole.ap70.value, 5)
        assert float(line["ap70_difference_from_5"]) == round(row.windows[5].ap70_difference.value, 5)
        assert float(line["infiltrated_from_5"]) == row.windows[5].infiltrated
        empty = ("ap70_se", "ap50_from_10", "infiltrated_from_10", "named_all", "honest", "milliseconds")
        assert [line[name] for name in empty] == [""] * len(empty)


def test_a_heat_map_of_the_table_is_that_of_the_rows(rows, plan, tmp_path):
    write_comparison(rows, plan(TRIO, SMALL), tmp_path, "")
    heat = read_table(tmp_path / "comparison.csv", "ap70")
    shown = {(row.setting.label, row.defense): row.whole for row in rows if row.defense != "oracle"}
    assert heat.texts == {place: f"{figures.ap70.value:.2f}" for place, figures in shown.items()}
    lost = {place: -figures.ap70_difference.value for place, figures in shown.items()}
    assert heat.colours == pytest.approx(lost, abs=1e-5)
    later = read_table(tmp_path / "comparison.csv", "ap70_from_5").colours
    assert later == pytest.approx(
        {(r.setting.label, r.defense): -r.windows[5].ap70_difference.value for r in rows if r.defense != "oracle"},
        abs=1e-5,
    )
    passes = read_table(tmp_path / "comparison.csv", "passes_first")
    assert passes.colours == pytest.approx({(r.setting.label, r.defense): r.passes_first for r in rows}, abs=1e-5)
    assert read_table(tmp_path / "comparison.csv", "named_all").texts == {}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "lacks one of the columns campaign, attackers, defense"),
        ("a,b\n1,2\n", "lacks one of the columns"),
        ("campaign,attackers,defense,ap50\npgd,1,none,0.5\n", "no figure 'ap70'; it has ap50"),
        ("campaign,attackers,defense,ap70\npgd,one,none,0.5\n", "'one' is no number of attackers"),
        ("campaign,attackers,defense,ap70\npgd,1,none,high\n", "'high' in ap70 is no number"),
        ("campaign,attackers,defense,ap70\npgd\n", "is no number of attackers"),
        ("\udcff", "is no table"),
    ],
)
def test_what_is_no_table_of_a_comparison_is_explained(text, why, tmp_path):
    path = tmp_path / "x.csv"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(TableError, match=why):
        read_table(path, "ap70")


def test_naming_has_its_own_tables(plan, tmp_path):
    defenses = {"a": Accuser(accused=("car-2", "car-3", "rsu"), patience=1)}
    extent = Extent((ERASED, NOBODY), 1, 6)
    rows = compare_defenses(plan(defenses, extent))
    text = write_comparison(rows, plan(defenses, extent), tmp_path, "").read_text()
    assert "| erase x 1 | 1.00 / 2.00 / 2 of 2 |" in text
    assert "## a in detail" in text
    ideal, own = rows[0].windows[5], rows[1].windows[5]
    assert (
        f"| erase x 1 | {ideal.ap50.value:.3f} / {ideal.ap70.value:.3f} | "
        f"{own.ap50.value:.3f} / {own.ap70.value:.3f} | "
        f"{own.ap50.value - ideal.ap50.value:+.3f} / {own.ap70.value - ideal.ap70.value:+.3f} | - | - | "
        f"{rows[1].whole.ap70.value / rows[0].whole.ap70.value:.3f} | {rows[2].whole.ap70.value:.3f} | "
        "0.0 / 0.0 / 0.00 | 1 of 1 | 2.0, 2 | 2 of 2 | 1 of 1 |"
    ) in text
    assert "Honest teammates named, over all attacks: 5 of 5. Sequences with any of them named: 2 of 2." in text
    with (tmp_path / "comparison.csv").open() as file:
        lines = [line for line in csv.DictReader(file) if line["defense"] == "a"]
    assert [(line["honest_named"], line["honest"]) for line in lines] == [("2", "2"), ("3", "3")]


def test_all_settings_can_be_made_and_attackers_leave_somebody_honest():
    for extent in (FULL, QUICK):
        assert extent.settings[0] == NOBODY
        assert len(set(extent.settings)) == len(extent.settings)
        for setting in extent.settings:
            load_campaign(setting.campaign)
            assert setting.attackers < 5
        assert extent.frames > 10  # sleepers wake
    assert set(QUICK.settings) <= set(FULL.settings)


@pytest.mark.parametrize("attack", ["displace", "frozen", "stale", "elsewhere", "copy"])
def test_a_full_comparison_plays_attacks_that_pretend_by_one_and_two_at_one_and_two_bounds(attack):
    pretending = {Setting(f"{attack}@denying{bound}", attackers) for bound in ("", "@double") for attackers in (1, 2)}
    assert {Setting(attack, 1), Setting(f"{attack}@soft", 1), *pretending} <= set(FULL.settings)


def test_the_command(tmp_path):
    short = ["--setting", "honest:0", "--scenes", "1", "--frames", "6"]
    only = ["--only", "halving", "--only", "no defence"]
    result = CliRunner().invoke(app, ["compare", "--quick", *only, *short, "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "out" / "comparison.md").read_text()
    assert "| attack | oracle | no defence | halving | ego only |" in text
    given = "--quick --only halving --only 'no defence' --setting honest:0 --scenes 1 --frames 6"
    assert f"`robosac compare --out DIR {given}`: 1 test sequences of 6 frames at 5 Hz, car-1 the ego" in text
    unknown = CliRunner().invoke(app, ["compare", "--only", "nonesuch", "--out", str(tmp_path)])
    assert unknown.exit_code == 2
    assert "known: 'no defence'" in unknown.output


def test_the_command_with_all_its_options(tmp_path):
    options = "--setting noise:1 --setting noise@asleep:1 --scenes 2 --frames 6 --pose-error 0.2"
    kept = tmp_path / "kept"
    arguments = ["compare", "--only", "halving", *options.split(), "--recordings", str(kept), "--out", str(tmp_path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    text = (tmp_path / "comparison.md").read_text()
    assert "| noise@asleep x 1 |" in text
    assert "wrong about their positions by 0.2 m" in text
    repeated = options.replace("--pose-error", "--recordings DIR --pose-error")
    assert f"`robosac compare --out DIR --only halving {repeated}`: 2 test sequences of 6 frames" in text
    assert len(list(kept.iterdir())) == 4  # honest and noise, of two scenes
    assert "+-" in text


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--setting", "nonesuch:1"], "no attack 'nonesuch'"),
        (["--setting", "erase@nonesuch:1"], "unknown behaviour"),
        (["--setting", "erase"], "CAMPAIGN:NUMBER"),
        (["--setting", "erase:6"], "erase:6: a scene of synthetic has 5 teammates"),
        (["--scenes", "1001"], "synthetic has 1000 test scenes; 1001 are wanted"),
        (["--data", "nonesuch"], "no scene source 'nonesuch'"),
        (
            ["--data", "tests.few:Numbered", "--scenes", "1", "--setting", "noise:1"],
            "few, scene 0: agents must be a sequence of one or more ids",
        ),
        (["--frames", "5"], "Invalid value for '--frames'"),
        (["--live", "--recordings", "x"], "nothing is recorded live"),
    ],
)
def test_options_that_make_no_sense_are_refused(arguments, complaint, tmp_path):
    result = CliRunner().invoke(app, ["compare", *arguments, "--out", str(tmp_path)], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert complaint in result.output


def test_settings_are_read_from_text():
    assert Setting.parse("erase@asleep:2") == Setting("erase@asleep", 2)
    assert Setting.parse("robosac.attacks:PGD@asleep:1") == Setting("robosac.attacks:PGD@asleep", 1)
    assert Setting.parse("pgd:0") == Setting.parse("honest:0") == NOBODY


def test_every_defence_of_the_table_has_a_row_and_answers(detector, plan):
    rows = compare_defenses(plan(built(DEFENSES, detector)[0], Extent((Setting("pgd", 1),), scenes=1, frames=6)))
    at = {row.defense: row for row in rows}
    assert set(at) == {"oracle", "ego only", *DEFENSES}
    for name in ("halving", "one_by_one", "conformal"):
        assert at[name].whole.infiltrated == 0.0
        assert at[name].whole.ap50.value > at["ego only"].whole.ap50.value + 0.1
    assert {name for name in DEFENSES if at[name].naming} == {name for name in DEFENSES if name.startswith("group")}
    assert np.isfinite([row.passes_steady for row in rows]).all()
