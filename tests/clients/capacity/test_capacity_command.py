import json

import pytest
import typer
from typer.testing import CliRunner

from clients.capacity.__main__ import main
from tests.clients.capacity.reports import a_report

APP = typer.Typer()
APP.command()(main)


@pytest.fixture
def report(tmp_path):
    path = tmp_path / "load_test.json"
    path.write_text(json.dumps(a_report(teams=(5,))))
    return path


def run(*arguments):
    return CliRunner().invoke(APP, [*map(str, arguments)])


def said(result):
    """What a command said, without the frame and its line breaks."""
    return " ".join(result.output.replace("│", "").split())


def test_a_plan_is_told_as_a_table_and_as_json(report, tmp_path):
    out = tmp_path / "out"
    result = run(report, "--vehicles", 400, "--attacked", 0, "--database-writes", 500, "--frames", 100, "--out", out)
    assert result.exit_code == 0, result.output
    told = json.loads((out / "capacity.json").read_text())
    assert told["scenario"]["vehicles"] == 400
    assert told["simulated"]["sessions_of_a_process"] >= told["formulas"]["sessions_of_a_process"]
    assert told["simulated"]["gpus"] is None
    assert told["formulas"]["breaks_first"] == "cores"
    for need in told["formulas"]["needs"]:
        assert need["resource"] in result.output
        assert f"| {need['resource']} |" in (out / "capacity.md").read_text()
    assert run(report, "--out", out).exit_code == 2  # it is there already


def test_a_model_that_is_off_ends_the_check_with_1(report, tmp_path):
    told = json.loads(report.read_text())
    for load in told["loads"]:
        load["fps"] *= 2.0 if load["egos"] == 4 and load["loop"] == "closed" else 1.0
    report.write_text(json.dumps(told))
    result = run("--check", report, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "further off than 20%" in result.output
    checks = json.loads((tmp_path / "out" / "check.json").read_text())["checks"]
    told = {(one["load"]["egos"], one["load"]["attacked"], one["figure"]) for one in checks}
    assert (4, True, "frames a second") in told


def test_a_check_that_could_compare_nothing_says_so(report):
    report.write_text(json.dumps(a_report(egos=(1,))))
    result = run("--check", report)
    assert result.exit_code == 2
    assert "no load to compare with" in said(result)


@pytest.mark.parametrize("option", ["--city", "--vehicles=9", "--budget-ms=200"])
def test_what_a_check_would_pass_over_is_refused(report, option):
    result = run("--check", report, option)
    assert result.exit_code == 2
    assert f"for {option.partition('=')[0]}: --check takes all figures from the report" in said(result)


def test_a_fleet_that_is_too_large_is_refused(report):
    assert "100000000" in said(run(report, "--vehicles", 10**20))


@pytest.mark.parametrize("cost", ["gateway_cpu_ms", "client_cpu_ms"])
@pytest.mark.parametrize("options", [("--frames", 10), ("--check",)])
def test_without_processor_time_nothing_is_told(report, options, cost, tmp_path):
    told = json.loads(report.read_text())
    for load in told["loads"]:
        load["used_a_frame"][cost] = None
    report.write_text(json.dumps(told))
    result = run(report, *options, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert f"the report has no {cost}" in said(result)
    assert not list((tmp_path / "out").iterdir())


def test_the_day_of_a_city_is_told_for_each_way_to_place_sessions(report, tmp_path):
    options = ["--vehicles", 60, "--frames", 40, "--city", "--out", tmp_path / "out"]
    result = run(report, *options)
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "out" / "capacity.json").read_text())
    hashed, even, too_few = told["city"].values()
    assert all(sum(day["shares"].values()) == pytest.approx(1.0) for day in (hashed, even, too_few))
    assert len(even["hours"]) == 24
    assert too_few["shares"]["tested"] < min(hashed["shares"]["tested"], even["shares"]["tested"])


def test_a_report_that_is_none_is_the_arguments_fault(tmp_path):
    (tmp_path / "x.json").write_text("{}")
    for path in (tmp_path / "x.json", tmp_path / "missing.json"):
        result = run(path)
        assert result.exit_code == 2
        assert "REPORT" in result.output


def test_a_team_that_was_not_measured_is_explained(report):
    result = run(report, "--teammates", 9)
    assert result.exit_code == 2
    assert "measured 5 only" in said(result)


def test_a_budget_without_time_for_a_frame_is_to_blame_itself(report):
    result = run(report, "--budget-ms", 1)
    assert result.exit_code == 2
    assert "for --budget-ms or --rate: no process answers 5 frames a second within 1 ms: one takes " in said(result)
