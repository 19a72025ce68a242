from dataclasses import replace

import pytest

from clients.capacity.checking import MOST_BUSY, OVERLAP, checks, predicted_fps
from clients.capacity.costs import costs_of, others_at_work
from clients.capacity.needs import Machine, Scenario, needs_of, on_the_wire, patience_ms
from clients.capacity.queueing import one_server_late, pool_late
from clients.capacity.report import MeasuredPace, Report
from tests.clients.capacity.reports import a_report

REPORT = Report.model_validate(a_report())
COSTS = costs_of(REPORT)
CITY, MACHINE = Scenario(1000, mean_share=0.5), Machine(16, 10.0, 1000.0, 2000.0)


def need(found, resource):
    (one,) = [need for need in found.needs if need.resource == resource]
    return one


def test_what_a_fleet_needs_is_frames_times_cost():
    found = needs_of(COSTS, CITY, MACHINE)
    assert found.frames_s == 5000
    assert found.cpu_ms == pytest.approx(28.5)
    assert need(found, "cores").needed == pytest.approx(5000 * 0.0285)
    assert found.cores == 204
    assert need(found, "cores").vehicles == pytest.approx(16 * 0.7 / (5 * 0.0285))
    in_bits = 5000 * 8 * on_the_wire(6 * 131_000, 3000)
    assert need(found, "network in").needed == pytest.approx(in_bits / 1e9)
    assert need(found, "disk a day").needed == pytest.approx(5000 * 86_400 * 0.5 * 2000 / 1e9)
    assert need(found, "disk kept").needed == pytest.approx(7 * 5000 * 86_400 * 0.5 * 2000 / 1e9)
    assert need(found, "database writes").vehicles == pytest.approx(400)


def test_a_network_carries_heads_of_segments_and_what_is_acknowledged():
    assert on_the_wire(1448, 0) == pytest.approx(1538)
    assert on_the_wire(0, 2 * 1448) == pytest.approx(90)


def test_a_process_has_as_many_sessions_as_wait_no_longer_than_they_may():
    found, service = needs_of(COSTS, CITY, MACHINE), COSTS.service(5, 0.0)
    patience = patience_ms(COSTS, CITY)
    assert patience == pytest.approx(0.5 * (200 - 37))
    assert one_server_late(found.sessions_of_a_process * 5e-3, service, patience) <= 0.01
    busier = (found.sessions_of_a_process + 1) * 5e-3
    assert one_server_late(busier, service, patience) > 0.01 or busier * service.mean > 0.7
    placed = found.processes
    assert placed["even"] == -(-1000 // found.sessions_of_a_process)
    assert placed["pool"] <= placed["even"] < placed["hashed"]
    assert placed["pool"] >= 5 * service.mean / 0.7


def test_processes_are_no_busier_on_average_than_they_may_be():
    service = COSTS.service(5, 0.0)
    for most in (6, 9, 30):
        placed = needs_of(COSTS, CITY, MACHINE, most).processes
        for processes in placed.values():
            assert 5 * service.mean / processes <= 0.7 + 1e-9
        assert placed["even"] <= placed["hashed"]


def test_a_pool_is_the_least_that_is_in_time_however_large_the_fleet():
    service = COSTS.service(5, 0.0)
    by_lateness = 0
    for vehicles in (3, 11, 23, 40, 700):
        scenario = replace(CITY, vehicles=vehicles, late=0.003, busy=0.95)
        found, patience = needs_of(COSTS, scenario, MACHINE).processes["pool"], patience_ms(COSTS, scenario)
        rate, late = scenario.frames_s / 1e3, []
        for servers in (found, found - 1):
            late.append(pool_late(rate, service, servers, patience) > scenario.late)
        too_few_to_be_idle = found - 1 < rate * service.mean / scenario.busy
        assert not late[0]
        assert late[1] or too_few_to_be_idle
        by_lateness += not too_few_to_be_idle
    assert by_lateness >= 2
    huge = needs_of(COSTS, replace(CITY, vehicles=100_000_000), MACHINE).processes
    assert huge["pool"] <= huge["even"]


def test_what_breaks_first_follows_the_scenario():
    assert needs_of(COSTS, CITY, MACHINE).breaks_first.resource == "cores"
    slow = replace(MACHINE, network_gbps=0.1)
    assert needs_of(COSTS, CITY, slow).breaks_first.resource == "network in"
    full = replace(MACHINE, disk_gb=10.0)
    assert needs_of(COSTS, CITY, full).breaks_first.resource == "disk kept"
    assert needs_of(COSTS, replace(CITY, retention_days=0), full).breaks_first.resource == "cores"
    few = replace(MACHINE, writes_s=100.0)
    assert needs_of(COSTS, CITY, few).breaks_first.resource == "database writes"


def test_attacks_and_larger_teams_cost_more_and_smaller_messages_less_network():
    base = needs_of(COSTS, CITY, MACHINE)
    assert needs_of(COSTS, replace(CITY, attacked=0.5), MACHINE).cpu_ms > base.cpu_ms
    assert needs_of(COSTS, replace(CITY, attacked=0.5), MACHINE).sessions_of_a_process < base.sessions_of_a_process
    assert needs_of(COSTS, replace(CITY, teammates=8), MACHINE).cpu_ms == pytest.approx(28.5 + 3 * 1.6)
    small = needs_of(COSTS, replace(CITY, message_bytes=13_100), MACHINE)
    assert need(small, "network in").needed == pytest.approx(need(base, "network in").needed / 10, rel=0.01)


def test_a_budget_that_nothing_fits_into_is_refused():
    with pytest.raises(ValueError, match="no process answers 5 frames a second within 30 ms"):
        needs_of(COSTS, replace(CITY, budget_ms=30), MACHINE)


LOCKED = 1e3 / 28.5 * OVERLAP
"""Frames a second of a process that has always some to do."""


def test_predictions_have_the_bounds_of_queues():
    one = next(load for load in REPORT.loads if load.loop == "closed" and not load.attacked and load.teammates == 5)
    assert predicted_fps(COSTS, one, 1, 2) == pytest.approx(1e3 / 37)  # as long as a frame takes by itself
    many = one.model_copy(update={"egos": 100})
    assert predicted_fps(COSTS, many, 1, 64) == pytest.approx(LOCKED, rel=1e-3)  # the interpreter's lock
    assert predicted_fps(COSTS, many, 2, 64) == pytest.approx(2 * LOCKED, rel=1e-3)
    assert predicted_fps(COSTS, many, 2, 1) == pytest.approx(MOST_BUSY * 1e3 / 32.5)  # the processor
    assert predicted_fps(COSTS, many.model_copy(update={"rate_hz": 0.1}), 2, 64) == pytest.approx(10)


MANY = REPORT.loads[0].model_copy(
    update={"loop": "closed", "egos": 100, "teammates": 5, "rate_hz": None, "sampling_steps_mean": 1.0}
)


def test_egos_are_where_they_fell():
    placed = MANY.model_copy(update={"placed": [100, 0]})
    assert predicted_fps(COSTS, placed, 2, 64) == pytest.approx(LOCKED, rel=1e-3)
    spread = placed.model_copy(update={"placed": [40, 60]})
    assert predicted_fps(COSTS, spread, 2, 64) == pytest.approx(2 * LOCKED, rel=1e-3)


def with_costs(change):
    """A report whose loads are changed; what a frame takes of the machine is known in it."""
    report = a_report()
    for load in report["loads"]:
        load["used_a_frame"]["machine_cpu_ms"] = load["used_a_frame"]["gateway_cpu_ms"] + 4.0
        change(load)
    return Report.model_validate(report)


def test_what_else_works_on_the_machine_takes_processor_time_too():
    def change(load):
        load["used_a_frame"]["machine_cpu_ms"] += 6.0

    assert predicted_fps(costs_of(with_costs(change)), MANY, 2, 1) == pytest.approx(MOST_BUSY * 1e3 / 38.5)


def at_pace(load, alone, together):
    load["pace"] = {"alone_ms": alone, "together_ms": together}
    slower = alone / 2.0
    for times in (load["used_a_frame"], *load["by_steps"].values()):
        times |= {name: value * slower for name, value in times.items() if name.endswith("_ms")}


def test_times_are_those_of_the_machines_pace():
    def change(load):
        at_pace(load, *((4.0, 4.0) if load["attacked"] else (2.0, 2.0)))

    costs = costs_of(with_costs(change))
    assert costs.pace_ms == 3.0  # half of the loads were measured at twice the pace of the others
    assert costs.used["gateway_cpu_ms"].at(5, 1) == pytest.approx(28.5 * 3 / 2)
    assert costs.used["audit_bytes"].at(5, 1) == pytest.approx(1600)
    slow = MANY.model_copy(update={"pace": costs_pace(6.0, 6.0)})
    assert predicted_fps(costs, slow, 2, 64) == pytest.approx(2 * LOCKED / 3, rel=1e-3)


def costs_pace(alone, together):
    return MeasuredPace(alone_ms=alone, together_ms=together)


def test_the_more_cores_work_the_slower_each_is():
    costs = costs_of(with_costs(lambda load: at_pace(load, 2.0, 2.0)))
    shared = MANY.model_copy(update={"pace": costs_pace(2.0, 3.0)})
    assert predicted_fps(costs, shared, 1, 64) == pytest.approx(LOCKED, rel=0.02)  # hardly any of the others works
    assert predicted_fps(costs, shared, 2, 2) == pytest.approx(
        MOST_BUSY * 2e3 / 32.5 / 1.5, rel=0.03
    )  # both cores do, nearly all the time
    alone = MANY.model_copy(update={"egos": 1, "placed": [1, 0], "pace": costs_pace(2.0, 3.0)})
    assert 1e3 / 37 / 1.3 < predicted_fps(costs, alone, 2, 2) < 1e3 / 37


def test_a_machine_of_one_core_has_no_others():
    assert others_at_work(100.0, 5.0, 50.0, 1, 1) == 0.0
    assert others_at_work(100.0, 10.0, 15.0, 2, 2) == 1.0
    assert others_at_work(50.0, 10.0, 12.0, 1, 3) == pytest.approx(0.05)


def test_only_what_costs_were_not_fitted_to_is_checked():
    found = checks(REPORT)
    assert {(one.load.loop, one.load.egos) for one in found} == {("closed", 4), ("open", 4)}
    by_figure = {one.figure for one in found}
    assert by_figure == {"frames a second", "disk bytes a frame", "audit bytes a frame"}
    assert all(one.holds for one in found if one.figure != "frames a second")
