import csv
from dataclasses import dataclass

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from robosac.attacks import load_campaign
from robosac.cli import app, compare
from robosac.defenses import Decision, OneByOne, Reason, Rejection, SampleConsensus, Source, Undefended
from robosac.evaluation.comparison import DEFENSES, FULL, QUICK, Extent, Setting, compare_defenses, write_comparison
from robosac.evaluation.comparison.playing import FaultyDefense
from robosac.evaluation.comparison.settings import NOBODY

ERASED = Setting("erase", 1)
LATE = Setting("noise@asleep", 2)


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class Broken(Undefended):
    def converse(self, team, state, rng):
        yield from ()
        raise RuntimeError("broken")


SMALL = Extent((NOBODY, ERASED), scenes=1, frames=6)


@pytest.fixture(scope="module")
def rows(request):
    detector = request.getfixturevalue("detector")
    ticks = []
    defenses = {"no defence": Undefended(), "one_by_one": OneByOne(), "sampling": SampleConsensus()}
    rows = compare_defenses(detector, defenses, SMALL, tick=lambda: ticks.append(1))
    assert len(ticks) == 12
    return rows


def test_every_defence_meets_every_setting_between_oracle_and_ego_alone(rows):
    names = ["oracle", "no defence", "one_by_one", "sampling", "ego only"]
    assert [(row.setting, row.defense) for row in rows] == [(s, n) for s in (NOBODY, ERASED) for n in names]


def test_what_was_answered_is_scored(rows):
    at = {(row.setting, row.defense): row for row in rows}
    quiet, ideal = at[NOBODY, "no defence"], at[NOBODY, "oracle"]
    assert (quiet.ap50, quiet.ap70, quiet.infiltrated, quiet.honest_refused) == (ideal.ap50, ideal.ap70, 0.0, 0.0)
    assert at[ERASED, "no defence"].ap70 < at[ERASED, "oracle"].ap70 - 0.05
    assert at[ERASED, "no defence"].infiltrated == 1.0
    assert at[ERASED, "oracle"].infiltrated == 0.0
    alone = at[ERASED, "ego only"]
    assert (alone.ap50, alone.honest_refused) == (at[NOBODY, "ego only"].ap50, 1.0)


def test_fused_passes_are_counted_for_each_defence_by_itself(rows):
    at = {(row.setting, row.defense): row for row in rows}

    def passes(name):
        row = at[NOBODY, name]
        return row.passes_first, row.passes_early, row.passes_steady

    assert passes("oracle") == passes("no defence") == passes("sampling") == (1.0, 1.0, 1.0)
    assert passes("one_by_one") == (6.0, 6.0, 6.0)
    assert passes("ego only") == (0.0, 0.0, 0.0)


def test_a_row_depends_on_nothing_else_that_is_compared(rows, detector):
    alone = compare_defenses(detector, {"sampling": SampleConsensus()}, Extent((ERASED,), 1, 6))
    assert alone == [row for row in rows if row.setting == ERASED and row.defense in ("oracle", "sampling", "ego only")]


def test_who_names_whom_and_when(detector):
    late = Extent((Setting("noise@asleep", 1),), scenes=1, frames=13)  # strikes in frames 10, 11 and 12
    (team_row,) = (r for r in compare_defenses(detector, {"mute": Undefended()}, late) if r.defense == "mute")
    assert (team_row.named_all, team_row.honest_named) == (None, None)
    team = ("car-2", "car-3", "car-4", "car-5", "rsu")
    accusers = {
        "everybody": Accuser(accused=team, patience=11),  # from frame 11 on, the second strike
        "at once": Accuser(accused=team, patience=0),
        "nobody": Accuser(),
    }
    at = {row.defense: row for row in compare_defenses(detector, accusers, late)}
    assert (at["everybody"].named_all, at["everybody"].frames_to_name, at["everybody"].honest_named) == (1.0, 2.0, 1.0)
    assert at["at once"].frames_to_name == 1.0
    assert (at["nobody"].named_all, at["nobody"].frames_to_name, at["nobody"].honest_named) == (0.0, None, 0.0)
    quiet = Extent((NOBODY,), scenes=1, frames=6)
    (calm,) = (r for r in compare_defenses(detector, {"a": Accuser(accused=team[:2])}, quiet) if r.defense == "a")
    assert (calm.named_all, calm.honest_named) == (None, 0.4)


def test_a_sleeping_attacker_counts_as_honest_until_it_strikes(detector):
    rows = compare_defenses(detector, {"no defence": Undefended()}, Extent((LATE,), scenes=1, frames=11))
    at = {row.defense: row for row in rows}
    assert at["no defence"].infiltrated == pytest.approx(1 / 11)
    assert at["ego only"].honest_refused == 1.0


def test_a_defence_that_fails_stops_the_comparison(detector):
    with pytest.raises(FaultyDefense, match="worse, frame 0: RuntimeError: broken"):
        compare_defenses(detector, {"worse": Broken()}, SMALL)


def test_the_report_holds_tables_and_pictures(rows, tmp_path):
    path = write_comparison(rows, SMALL, tmp_path, "the command")
    text = path.read_text()
    assert "`the command`: 1 test sequences of 6 frames" in text
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
        assert float(line["ap70"]) == round(row.ap70, 4)
        assert line["named_all"] == ""


def test_naming_has_its_own_table(detector, tmp_path):
    rows = compare_defenses(detector, {"a": Accuser()}, Extent((ERASED,), 1, 6))
    text = write_comparison(rows, SMALL, tmp_path, "").read_text()
    assert "| erase x 1 | 0.00 / - / 0.00 |" in text
    assert "when nobody attacks" not in text


def test_all_settings_can_be_made_and_attackers_leave_somebody_honest():
    for extent in (FULL, QUICK):
        assert extent.settings[0] == NOBODY
        assert len(set(extent.settings)) == len(extent.settings)
        for setting in extent.settings:
            load_campaign(setting.campaign)
            assert setting.attackers < 5
        assert extent.frames > 10  # sleepers wake
    assert set(QUICK.settings) <= set(FULL.settings)


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(compare, "QUICK", Extent((NOBODY,), scenes=1, frames=6))
    only = ["--only", "halving", "--only", "no defence"]
    result = CliRunner().invoke(app, ["compare", "--quick", *only, "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "out" / "comparison.md").read_text()
    assert "| attack | oracle | no defence | halving | ego only |" in text
    assert "robosac compare --out DIR --seed 0 --only halving --only no defence --quick" in text
    unknown = CliRunner().invoke(app, ["compare", "--only", "nonesuch", "--out", str(tmp_path)])
    assert unknown.exit_code == 2
    assert "known: no defence" in unknown.output


def test_every_defence_of_the_table_has_a_row_and_answers(detector):
    defenses = {name: make(detector) for name, make in DEFENSES.items()}
    rows = compare_defenses(detector, defenses, Extent((Setting("pgd", 1),), scenes=1, frames=6))
    at = {row.defense: row for row in rows}
    assert set(at) == {"oracle", "ego only", *DEFENSES}
    for name in ("halving", "one_by_one", "conformal"):
        assert at[name].infiltrated == 0.0
        assert at[name].ap50 > at["ego only"].ap50 + 0.1
    assert np.isfinite([row.passes_steady for row in rows]).all()
