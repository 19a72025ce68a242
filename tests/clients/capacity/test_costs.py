import json

import pytest

from clients.capacity.costs import Line, calibration, costs_of
from clients.capacity.report import Report, read_report
from tests.clients.capacity.reports import CPU, ENGINE, LATENCY, a_report


def test_costs_are_what_the_report_was_made_from():
    costs = costs_of(Report.model_validate(a_report()))
    for line, known in ((costs.engine_ms, ENGINE), (costs.latency_ms, LATENCY), (costs.used["gateway_cpu_ms"], CPU)):
        assert (line.base, line.teammate, line.step) == pytest.approx(known, rel=1e-6)
    assert costs.a_frame("gateway_cpu_ms", 5, 0.0) == pytest.approx(13 + 8 + 7.5)
    assert costs.mean_steps(True, 5) == pytest.approx(1.95)
    service = costs.service(5, 0.25)
    times = {21 + 7.5 * n: p for n, p in {1: 0.75 + 0.125, 2: 0.0625, 3: 0.0375, 5: 0.025}.items()}
    assert service.mean == pytest.approx(sum(t * p for t, p in times.items()))
    assert service.square == pytest.approx(sum(t**2 * p for t, p in times.items()))


def test_costs_come_from_loads_in_which_nothing_waits():
    loads = calibration(Report.model_validate(a_report()))
    assert {(load.loop, load.egos) for load in loads} == {("open", 1), ("closed", 1)}
    assert len(loads) == 8
    loads = calibration(Report.model_validate(a_report(egos=(2, 4))))
    assert {(load.loop, load.egos) for load in loads} == {("open", 2)}


def test_no_cost_is_below_zero():
    line = Line.through([(5, 1, 10.0, 1), (5, 2, 8.0, 1), (5, 3, 9.0, 1)])
    assert min(line.base, line.teammate, line.step) >= 0
    assert line.at(5, 2) == pytest.approx(9.0)


def test_what_was_not_measured_is_not_made_up():
    one_team = costs_of(Report.model_validate(a_report(teams=(5,))))
    one_team.check_team(5)
    with pytest.raises(ValueError, match=r"7 teammates: the load test measured 5 only.*--teammates 3"):
        one_team.check_team(7)
    report = a_report()
    for load in report["loads"]:
        load["used_a_frame"]["disk_bytes"] = None
    assert costs_of(Report.model_validate(report)).a_frame("disk_bytes", 5, 0.0) is None
    honest = {**report, "loads": [load for load in report["loads"] if not load["attacked"]]}
    with pytest.raises(ValueError, match="without and with an attacker"):
        costs_of(Report.model_validate(honest))


def used(report):
    return report["loads"][0]["used_a_frame"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda report: report["loads"][0].pop("by_steps"), r"loads\.0\.by_steps"),
        (lambda report: report["loads"][3].update(fps=0), r"loads\.3\.fps"),
        (lambda report: report.update(loads=[]), "loads"),
        (
            lambda report: used(report).update(gateway_cpu_ms=0.0),
            r"loads\.0\.used_a_frame: gateway_cpu_ms must be above 0",
        ),
        (
            lambda report: used(report).update(machine_cpu_ms=0.0),
            r"loads\.0\.used_a_frame: machine_cpu_ms must be above 0",
        ),
        (lambda report: used(report).update(disk_bytes=-5.0), r"loads\.0\.used_a_frame\.disk_bytes"),
        (lambda report: used(report).update(gateway_cpu_ms=1e999), r"loads\.0\.used_a_frame\.gateway_cpu_ms"),
        (lambda report: report["loads"][0]["stages_ms"].update(store=-4.0), r"loads\.0\.stages_ms\.store"),
        (lambda report: report.pop("machine"), "machine"),
    ],
)
def test_a_report_that_is_none_is_refused_by_its_field(tmp_path, change, field):
    report = a_report()
    change(report)
    path = tmp_path / "load_test.json"
    path.write_text(json.dumps(report))
    with pytest.raises(ValueError, match=rf"load_test\.json: {field}: "):
        read_report(path)


def test_a_file_that_holds_no_json_is_refused(tmp_path):
    (tmp_path / "x.json").write_text("not json")
    with pytest.raises(ValueError, match="Invalid JSON"):
        read_report(tmp_path / "x.json")
