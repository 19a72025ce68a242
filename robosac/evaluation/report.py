"""Reports: Markdown with tables and pictures, and CSV beside it."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robosac.files import replacing, write_text


@dataclass(frozen=True)
class Table:
    """A table of a report."""

    name: str
    """Of the CSV file beside the report that holds the same; none if it is empty."""
    caption: str
    """Stands before the table, with the CSV file's name."""
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    """Cells are strings or numbers; None is empty."""

    @classmethod
    def of(cls, lines: Sequence[Mapping[str, Any]], name: str = "", caption: str = "") -> Table:
        """Of lines that all have the same columns."""
        return cls(name, caption, list(lines[0]) if lines else [], [list(line.values()) for line in lines])


@dataclass(frozen=True)
class Section:
    """A part of a report: what it shows in words, its tables, and the pictures that were drawn (file names)."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    pictures: Sequence[str] = ()


def write_report(path: Path, head: str, sections: Iterable[Section]) -> Path:
    """Write a Markdown page and, beside it, a CSV file for each table with a name; returns the page's path."""
    parts = [head]
    for section in sections:
        parts.append(f"## {section.title}\n")
        if section.text:
            parts.append(f"{section.text}\n")
        for table in section.tables:
            if table.name:
                write_csv(path.with_name(f"{table.name}.csv"), table)
                parts.append(f"{table.caption} ([{table.name}.csv]({table.name}.csv)):\n")
            parts.append(markdown(table) + "\n")
        parts += [f"![{section.title}]({picture})\n" for picture in section.pictures]
    write_text(path, "\n".join(parts))
    return path


def markdown(table: Table) -> str:
    """The table in Markdown."""
    lines = [table.columns, *(["" if cell is None else str(cell) for cell in row] for row in table.rows)]
    first, *rest = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([first, "|" + "---|" * len(table.columns), *rest])


def write_csv(path: Path, table: Table) -> None:
    """Write a table as a CSV file; None is an empty cell."""
    with replacing(path) as beside, beside.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        writer.writerows(table.rows)
