import csv

import numpy as np
import pytest
from matplotlib.image import imread

from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS, EmbeddedDetector
from robosac.evaluation.experiments import EXPERIMENTS, Context, Scale, theory
from robosac.evaluation.report import write_report
from robosac.scenes.intersection import Synthetic

TINY = Scale(scenes=2, frames_per_scene=1, sequences=1, sequence_frames=6, repeats=2, oracle_runs=100)


def make_context(out):
    detector, hardened = EmbeddedDetector(), EmbeddedDetector(ADVERSARIAL_WEIGHTS)
    return Context(TINY, 0, out, detector, hardened, Synthetic(), lambda label, total: lambda: None)


@pytest.fixture(scope="module")
def context(tmp_path_factory):
    return make_context(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def sections(context):
    return {name: experiment(context) for name, experiment in EXPERIMENTS.items()}


def rows(section, table=0):
    found = section.tables[table]
    return [dict(zip(found.columns, row, strict=True)) for row in found.rows]


def test_the_derivation_follows_the_exact_law(sections):
    for row in rows(sections["derivation"]):
        assert row["oracle"] == pytest.approx(row["exact"], rel=0.35)
        assert row["detector"] >= 1.0
    for row in rows(sections["derivation"], 1):
        assert row["oracle"] == pytest.approx(row["exact"], abs=0.1)


@pytest.mark.parametrize(
    ("steps", "mean", "never"), [([2, theory.NEVER, 4, 3], 3.0, 0.25), ([theory.NEVER], None, 1.0)]
)
def test_runs_that_never_agree_are_not_in_the_mean(steps, mean, never):
    assert theory.until_consensus(np.array(steps)) == (mean, never)


def test_budgets_stand_between_the_bounds(sections):
    table = {row["perception"]: row for row in rows(sections["budgets"])}
    assert table["all benign"]["AP50"] > table["no defence"]["AP50"]
    assert table["3 benign"]["AP50 / 3 benign"] == 1.0
    assert table["Algorithm 1, N = 1"]["steps"] == 1.0
    assert table["all benign"]["AP50 %, paper"] == 81.3


def test_a_trusted_team_costs_no_more_than_no_defence(sections):
    table = {row["session"]: row for row in rows(sections["teams"])}
    assert table["undefended"]["median cost"] == 1.0
    assert table["static team, no re-check"]["median cost"] < table["dynamic team"]["median cost"]
    assert table["static team, no re-check"]["steps"] < table["dynamic team"]["steps"]
    assert table["undefended"]["attacker in answer"] == 1.0
    assert table["dynamic team"]["attacker in answer"] == 0.0
    assert all(row["FPS, measured"] > 0 for row in table.values())
    assert all(0 <= row["rate"] <= 1 for row in rows(sections["teams"], 1))


def test_every_attack_is_met_by_both_defences(sections):
    table = {row["attack"]: row for row in rows(sections["generalisation"])}
    assert set(table) == {"pgd", "bim", "cw", "pgd, twice the bound", "noise", "erase"}
    assert table["pgd"]["Algorithm 1 AP50"] > table["pgd"]["no defence AP50"]
    assert table["cw"]["PGD-trained AP50 %, paper"] == 43.2


def test_a_strict_threshold_refuses_more_and_misses_less(sections):
    loose, *_, strict = rows(sections["ablation"])
    assert strict["false alarms"] >= loose["false alarms"]
    assert strict["misses"] <= loose["misses"]
    weak, *_, strong = rows(sections["ablation"], 1)
    assert strong["no defence AP50"] < weak["no defence AP50"]


def test_the_attacker_ratio_is_estimated(sections):
    table = rows(sections["ratio-estimation"])
    assert [row["true ratio"] for row in table] == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert len(sections["ratio-estimation"].tables[0].rows[0]) == 7
    first, last = sections["ratio-estimation"].tables[0].rows[0], sections["ratio-estimation"].tables[0].rows[-1]
    assert (first[2], first[5]) == (1.0, 0.0)
    assert (last[2], last[5]) == (77.0, 1.0)


def test_the_papers_examples_come_out(sections):
    assert all(row["paper"] == row["ours"] for row in rows(sections["numerical"]))


def test_the_report_holds_every_table_and_picture(context, sections):
    path = write_report(context.out / "report.md", "the head\n", sections.values())
    text = path.read_text()
    assert text.startswith("the head\n\n## ")
    for section in sections.values():
        assert f"## {section.title}" in text
        for table in section.tables:
            with (context.out / f"{table.name}.csv").open() as file:
                assert len(list(csv.reader(file))) == len(table.rows) + 1
            assert f"({table.name}.csv)" in text
        for picture in section.pictures:
            assert imread(context.out / picture).std() > 0.01
            assert f"({picture})" in text


def test_the_same_seed_gives_the_same_figures(context, sections, tmp_path):
    assert EXPERIMENTS["budgets"](make_context(tmp_path)).tables == sections["budgets"].tables
