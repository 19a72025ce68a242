"""Tables of what was worked out, for the eye and for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from clients import trial
from clients.capacity.checking import Check
from clients.capacity.needs import Needs, Scenario

PLACEMENTS = {"hashed": "sessions hashed", "even": "sessions spread evenly", "pool": "frames go anywhere"}


@dataclass(frozen=True)
class Sheet:
    """A table; its first column has words."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def rich(self) -> Table:
        """For a terminal."""
        table = trial.a_table(self.title, self.columns)
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        """For a page."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join([f"**{self.title}**", "", *(f"| {' | '.join(line)} |" for line in lines), ""])


def needs_sheets(safe: Needs, found: Needs, scenario: Scenario) -> list[Sheet]:
    """What a fleet needs, and how many processes, by the formulas and by the simulation."""
    title = (
        f"{scenario.vehicles} vehicles at {scenario.rate_hz:g} Hz with {scenario.teammates} teammates, "
        f"{scenario.attacked:.0%} attacked: {found.frames_s:.0f} frames a second"
    )
    resources = [
        [one.resource, f"{_number(one.needed)} {one.unit}".strip(), _number(one.has), _number(one.vehicles)]
        for one in found.needs
    ]
    processes = [
        ["sessions of a process", str(safe.sessions_of_a_process), str(found.sessions_of_a_process)],
        *(
            [f"processes, {text}", str(safe.processes[name]), str(found.processes[name])]
            for name, text in PLACEMENTS.items()
        ),
    ]
    return [
        Sheet(title, ["resource", "needed", "a machine may use", "for vehicles"], resources),
        Sheet("Processes", ["", "by M/G/1", "by simulation"], processes),
    ]


def checks_sheet(found: Sequence[Check]) -> Sheet:
    """Predictions beside what was measured."""
    rows = []
    for one in found:
        load = one.load
        label = [load.loop, str(load.teammates), str(load.egos), "PGD" if load.attacked else "none", one.figure]
        rows.append([*label, f"{one.predicted:.1f}", f"{one.measured:.1f}", f"{one.off:+.0%}"])
    columns = ["loop", "team", "egos", "attack", "figure", "model", "measured", "off"]
    return Sheet("Predicted from single egos", columns, rows)


def city_sheet(days: Mapping[str, Any], scenario: Scenario) -> Sheet:
    """What came of a day, for each plan."""
    rows = []
    for label, day in days.items():
        worst = min(hour.outcomes.shares()["tested"] for hour in day.hours if hour.outcomes.frames)
        shares = [f"{share:.3%}" for share in day.outcomes.shares().values()]
        rows.append([label, *shares, f"{worst:.3%}", f"{day.process_failures} + {day.database_failures}"])
    columns = ["plan", "tested", "untested", "late", "refused", "lost", "worst hour", "failures"]
    title = f"A day of a city, {scenario.vehicles} vehicles at the peak: shares of its frames"
    return Sheet(f"{title}; failures of processes + databases", columns, rows)


def page(title: str, machine: str, sheets: Sequence[Sheet]) -> str:
    """Tables as a page."""
    return "\n".join([f"# {title}", "", f"Made by `robosac capacity`. {machine}", "", *(s.markdown() for s in sheets)])


def _number(value: float | None) -> str:
    """Three digits and no exponent; a dash for nothing."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
