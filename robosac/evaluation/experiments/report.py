"""Writing a report: Markdown, with CSV and PNG beside it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robosac.evaluation.experiments.common import Section, Table

HEAD = """# Every experiment of the paper, on the synthetic intersection

Made by `{command}` in {minutes:.0f} minutes.

**Average precision on this synthetic world is not comparable with the paper's on V2X-Sim.** World, detector and attack
differ. What compares is put side by side: orderings, ratios to the bounds, sampling steps, success rates, estimated
ratios. The paper is *Among Us: Adversarially Robust Collaborative Perception by Consensus* (ICCV 2023).
"""


def write_report(sections: Sequence[Section], out: Path, command: str, minutes: float) -> Path:
    """Write ``report.md``, and a CSV for each table; returns the report's path."""
    parts = [HEAD.format(command=command, minutes=max(minutes, 1.0))]
    for section in sections:
        parts.append(f"## {section.title}\n\n{section.text}\n")
        for table in section.tables:
            _write_csv(table, out / f"{table.name}.csv")
            parts.append(f"{table.caption} ([{table.name}.csv]({table.name}.csv)):\n\n{_markdown(table)}\n")
        parts += [f"![{section.title}]({picture})\n" for picture in section.pictures]
    path = out / "report.md"
    path.write_text("\n".join(parts))
    return path


def _markdown(table: Table) -> str:
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    lines += ["| " + " | ".join(_cell(value) for value in row) + " |" for row in table.rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return "" if value is None else str(value)


def _write_csv(table: Table, path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        writer.writerows(table.rows)
