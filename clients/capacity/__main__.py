"""What a fleet needs, from what a load test measured: ``robosac capacity``."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from clients import trial
from clients.capacity.checking import WITHIN, Check, checks
from clients.capacity.costs import Costs, costs_of
from clients.capacity.needs import Machine, Needs, NoneInTime, Scenario, needs_of
from clients.capacity.report import read_report
from clients.capacity.sheets import Sheet, checks_sheet, city_sheet, needs_sheets, page
from robosac.cli.blame import blaming
from robosac.extras import need
from robosac.files import write_text

if TYPE_CHECKING:
    from clients.capacity.city import Day, Table

PLAN, CHECK = "capacity", "check"
"""Names of the reports: each with .json, and as a page with .md."""
MOST_VEHICLES = 100_000_000
VEHICLES_OF_A_CROSSING = 10
"""On average, at the peak."""
_OF_CHECKS = {"report", "check", "out", "force"}


def main(  # the options of a command line
    context: typer.Context,
    report: Annotated[Path, typer.Argument(help="What `robosac load-test --out` wrote: load_test.json.")],
    vehicles: Annotated[
        int, typer.Option(min=1, max=MOST_VEHICLES, help="Vehicles at the peak, each with a session.")
    ] = 100_000,
    rate: Annotated[float, typer.Option(min=1.0, help="Frames a second of a vehicle.")] = 5.0,
    teammates: Annotated[int, typer.Option(min=1, help="Teammates of a vehicle.")] = 5,
    attacked: Annotated[float, typer.Option(min=0, max=1, help="Share of the sessions with an attacker.")] = 0.05,
    message_bytes: Annotated[
        int | None, typer.Option(min=1, help="Of one vehicle's message; by default as measured.")
    ] = None,
    budget_ms: trial.Budget = 200.0,
    late: Annotated[float, typer.Option(min=1e-6, max=0.5, help="Share of the frames that may wait too long.")] = 0.01,
    busy: Annotated[float, typer.Option(min=0.05, max=0.95, help="How busy cores and threads may be.")] = 0.7,
    mean_share: Annotated[float, typer.Option(min=0.01, max=1, help="The day's mean, of its peak.")] = 0.46,
    retention_days: Annotated[float, typer.Option(min=0, help="How long audit logs are kept.")] = 7.0,
    cores: Annotated[int, typer.Option(min=1, help="Cores of a machine.")] = 16,
    network_gbps: Annotated[float, typer.Option(min=0.001, help="Network of a machine.")] = 10.0,
    disk_gb: Annotated[float, typer.Option(min=1, help="Disk for the database of a machine's sessions.")] = 1000.0,
    database_writes: Annotated[
        float | None, typer.Option(min=1, help="Transactions a second of a database, where that is measured.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Compare the model with the report's other loads.")] = False,
    city: Annotated[bool, typer.Option("--city", help="Simulate a day of the whole city.")] = False,
    frames: Annotated[
        int, typer.Option(min=1, help="That are simulated for each number of sessions of a process.")
    ] = 4000,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulations.")] = 0,
    out: trial.Out = None,
    force: trial.Force = False,
) -> None:
    """Work out what a fleet needs of gateways, and what breaks first, from what a load test measured.

    With --check it ends with 1 where the model is further off than 20 %.
    """
    need("simpy", "simulations")
    if check:
        _refuse_other_options(context)
    console = Console()
    name = CHECK if check else PLAN
    trial.make_folder(out, "--out", f"{name}.json", force)
    scenario = Scenario(
        vehicles, rate, teammates, attacked, budget_ms, late, busy, mean_share, retention_days, message_bytes
    )
    machine = Machine(cores, network_gbps, disk_gb, database_writes)
    told: dict[str, Any] = {"scenario": asdict(scenario), "machine": asdict(machine)}
    found: list[Check] = []
    with blaming("REPORT", ValueError, OSError):
        measured = read_report(report)
        if check:
            found = checks(measured)
            told["checks"] = [asdict(one) | {"load": one.load.model_dump()} for one in found]
            sheets = [checks_sheet(found)]
        else:
            with blaming("--budget-ms or --rate", NoneInTime):
                rng = np.random.default_rng(seed)
                planned, sheets = _planned(costs_of(measured), scenario, machine, rng, frames, city)
            told |= planned
    for sheet in sheets:
        console.print(sheet.rich())
    if out is not None:
        title = "The model against measurement" if check else "What a fleet needs"
        write_text(out / f"{name}.md", page(title, measured.machine.words, sheets))
    trial.write(told, out, f"{name}.json", console)
    if not all(one.holds for one in found):
        console.print(f"[red]The model is further off than {WITHIN:.0%}.[/red]")
        sys.exit(1)


def _refuse_other_options(context: typer.Context) -> None:
    """A check takes everything from the report; what is asked for besides would be passed over without a word."""
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        if source is not None and source.name == "COMMANDLINE" and option.name not in _OF_CHECKS:
            raise typer.BadParameter("--check takes all figures from the report", param_hint=option.opts[0])


def _planned(
    costs: Costs, scenario: Scenario, machine: Machine, rng: np.random.Generator, frames: int, city: bool
) -> tuple[dict[str, Any], list[Sheet]]:
    """What a fleet needs, by the formulas and by a simulation of one process; and what comes of a day."""
    from clients.capacity.city import Table  # noqa: PLC0415 (which needs simpy)

    safe = needs_of(costs, scenario, machine)
    table = Table(costs, scenario, rng, frames=frames)
    found = needs_of(costs, scenario, machine, table.most_sessions(scenario.late))
    told: dict[str, Any] = {"formulas": safe.as_dict(), "simulated": found.as_dict()}
    sheets = needs_sheets(safe, found, scenario)
    if city:
        databases = max(1, round(found.frames_s / machine.writes_s)) if machine.writes_s else 1
        days = _days(scenario, table, found, databases, rng)
        told["city"] = {name: asdict(day) | {"shares": day.outcomes.shares()} for name, day in days.items()}
        sheets.append(city_sheet(days, scenario))
    return told, sheets


def _days(scenario: Scenario, table: Table, found: Needs, databases: int, rng: np.random.Generator) -> dict[str, Day]:
    """A day with as many processes as each placement needs, and with too few for placement by hashes."""
    from clients.capacity.city import City, simulate_day  # noqa: PLC0415 (which needs simpy)

    days = {}
    for placed, enough_for in (("hashed", "hashed"), ("even", "even"), ("hashed", "even")):
        processes = found.processes[enough_for]
        city = City(
            crossings=max(1, scenario.vehicles // VEHICLES_OF_A_CROSSING),
            processes=processes,
            hashed=placed == "hashed",
            databases=min(databases, processes),
        )
        days[f"{placed}, {processes} processes"] = simulate_day(city, scenario, table, rng)
    return days


if __name__ == "__main__":
    typer.run(main)
