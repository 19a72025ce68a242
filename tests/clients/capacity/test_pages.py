"""The pages on capacity are what the model makes of the report beside them."""

import json
from pathlib import Path

import pytest

from clients.capacity.checking import checks
from clients.capacity.costs import costs_of
from clients.capacity.needs import Machine, Scenario, needs_of
from clients.capacity.report import read_report
from clients.capacity.sheets import checks_sheet, needs_sheets

FOLDER = Path(__file__).parents[3] / "docs" / "capacity"
REPORT = read_report(FOLDER / "load_test.json")


def test_the_plan_is_that_of_the_report_and_the_scenario():
    told = json.loads((FOLDER / "capacity.json").read_text())
    scenario, machine = Scenario(**told["scenario"]), Machine(**told["machine"])
    sessions = told["simulated"]["sessions_of_a_process"]
    safe, found = (needs_of(costs_of(REPORT), scenario, machine, most) for most in (None, sessions))
    for name, needs in (("formulas", safe), ("simulated", found)):
        known = json.loads(json.dumps(needs.as_dict()))
        assert {field: known[field] for field in ("processes", "cores", "breaks_first")} == {
            field: told[name][field] for field in ("processes", "cores", "breaks_first")
        }
    page = (FOLDER / "capacity.md").read_text()
    for sheet in needs_sheets(safe, found, scenario):
        assert sheet.markdown() in page
    for label, day in told["city"].items():
        assert f"| {label} | {day['shares']['tested']:.3%} |" in page


@pytest.mark.parametrize("folder", [FOLDER, FOLDER / "two"])
def test_the_check_is_that_of_the_report(folder):
    report = read_report(folder / "load_test.json")
    assert checks_sheet(checks(report)).markdown() in (folder / "check.md").read_text()


@pytest.mark.parametrize(
    ("folder", "figures"),
    [
        (FOLDER, {"disk bytes a frame", "audit bytes a frame", "frames a second"}),
        (FOLDER / "two", {"disk bytes a frame", "audit bytes a frame"}),
    ],
)
def test_the_model_is_near_what_was_measured(folder, figures):
    found = [one for one in checks(read_report(folder / "load_test.json")) if one.figure in figures]
    assert len(found) > 4 * len(figures)
    assert not [(one.load, one.off) for one in found if not one.holds]
