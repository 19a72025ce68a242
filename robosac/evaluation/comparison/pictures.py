"""Pictures of a comparison."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE
from robosac.evaluation.comparison.rows import EARLY, Row
from robosac.evaluation.comparison.settings import NOBODY, Setting
from robosac.figures import new_figure, save_figure

WHERE = ("campaign", "attackers", "defense")
"""Columns of a table that tell where a figure belongs."""
Place = tuple[str, str]
"""Setting and defence, as a heat map is labelled."""


class TableError(ValueError):
    """A file is no table of a comparison, or does not have what is asked of it."""


class UnknownColumn(TableError):
    """A table has no such column of numbers."""


@dataclass(frozen=True)
class HeatMap:
    """Figures of a comparison, to be drawn: a line for each setting, a column for each defence."""

    title: str
    texts: Mapping[Place, str]
    """What is written; nothing where there is no figure."""
    colours: Mapping[Place, float]
    """What is coloured, of the same places."""
    most: float | None = None
    """What gets the darkest colour, at least; by default the most that there is."""


def draw_precision(rows: Sequence[Row], path: Path) -> None:
    """AP70 of each defence in each setting as numbers, coloured by the loss against the oracle."""
    shown = [row for row in rows if row.defense != ORACLE]
    texts = {(row.setting.label, row.defense): f"{row.whole.ap70.value:.2f}" for row in shown}
    lost = {(row.setting.label, row.defense): 0.0 - row.whole.ap70_difference.value for row in shown}
    draw_heat_map(HeatMap("AP at IoU 0.7; colour: lost against the oracle", texts, lost, 0.5), path)


def read_table(path: Path, column: str) -> HeatMap:
    """A column of the table that a comparison wrote; precision is coloured by the loss against the oracle.

    Parameters
    ----------
    path : Path
        ``comparison.csv`` or ``worlds.csv``.
    column : str

    Raises
    ------
    TableError
        If it is no such table; `UnknownColumn` if it has no such column of numbers.
    OSError
        If it cannot be read.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file, restval=""))
    except (UnicodeDecodeError, csv.Error) as error:
        raise TableError(f"{path} is no table: {error}") from error
    if not lines or not set(WHERE) <= lines[0].keys():
        raise TableError(f"{path} is no table of robosac compare: it lacks one of the columns {', '.join(WHERE)}")
    if column not in lines[0] or column in WHERE:
        known = [name for name in lines[0] if name not in (*WHERE, "world")]
        raise UnknownColumn(f"{path} has no figure {column!r}; it has {', '.join(known)}")
    name, at, first = column.partition("_from_")
    difference = f"{name}_difference{at}{first}"
    against = difference if difference in lines[0] else None
    values = {_place(line, path): _number(line, column, path) for line in lines}
    texts = {place: f"{value:.2f}" for place, value in values.items() if not math.isnan(value)}
    said = column.replace("ap50", "AP at IoU 0.5").replace("ap70", "AP at IoU 0.7").replace("_", " ")
    if against is None:
        return HeatMap(said, texts, {place: values[place] for place in texts})
    lost = {_place(line, path): 0.0 - _number(line, against, path) for line in lines}
    shown = [place for place in texts if place[1] != ORACLE]
    colours = {place: lost[place] for place in shown}
    return HeatMap(f"{said}; colour: lost against the oracle", {p: texts[p] for p in shown}, colours, 0.5)


def draw_heat_map(heat: HeatMap, path: Path) -> None:
    """Figures as numbers on their colours, of a scale whose lightness falls evenly."""
    settings, names = (list(dict.fromkeys(place[axis] for place in heat.texts)) for axis in (0, 1))
    values = np.array([[heat.colours.get((s, n), np.nan) for n in names] for s in settings]).reshape(-1, len(names))
    low = min(0.0, float(np.nanmin(values, initial=0.0)))
    high = max(heat.most or 0.0, float(np.nanmax(values, initial=0.0))) or 1.0
    figure = new_figure(3.2 + 0.62 * len(names), 1.9 + 0.25 * len(settings))
    axes = figure.add_subplot()
    image = axes.imshow(values, cmap="OrRd", vmin=low, vmax=high, aspect="auto")
    for (setting, name), text in heat.texts.items():
        i, j = settings.index(setting), names.index(name)
        colour = "white" if values[i, j] > low + 0.6 * (high - low) else "black"
        axes.text(j, i, text, ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=8)
    axes.set_yticks(range(len(settings)), settings, fontsize=8)
    axes.set_title(heat.title, fontsize=9)
    figure.colorbar(image, ax=axes)
    save_figure(figure, path, dpi=110)


def draw_passes(rows: Sequence[Row], path: Path) -> None:
    """Each defence's mean AP70 over the settings with attackers against its fused passes in later frames."""
    figure = new_figure(6.5, 4.2)
    axes = figure.add_subplot()
    for name in dict.fromkeys(row.defense for row in rows):
        mine = [row for row in rows if row.defense == name and row.setting != NOBODY]
        if not mine:
            continue
        x = float(np.mean([row.passes_steady for row in mine]))
        y = float(np.mean([row.whole.ap70.value for row in mine]))
        marker = "x" if name in (ORACLE, EGO_ONLY) else "o"
        axes.scatter([x], [y], marker=marker)
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(5, 4), fontsize=8)
    axes.set_xlabel(f"fused passes a frame, after the first {EARLY}")
    axes.set_ylabel("AP at IoU 0.7, mean over the attacks")
    axes.grid(alpha=0.3)
    save_figure(figure, path, dpi=110)


def _place(line: Mapping[str, str], path: Path) -> Place:
    number = line["attackers"]
    if not number.isdecimal():
        raise TableError(f"{path}: {number!r} is no number of attackers")
    world = f"{line['world']}: " if "world" in line else ""
    return f"{world}{Setting(line['campaign'], int(number)).label}", line["defense"]


def _number(line: Mapping[str, str], column: str, path: Path) -> float:
    try:
        return float(line[column] or "nan")
    except (TypeError, ValueError) as error:
        raise TableError(f"{path}: {line[column]!r} in {column} is no number") from error
