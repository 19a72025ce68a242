"""Tables and pictures of a comparison."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from robosac.evaluation.comparison.playing import EARLY, EGO_ONLY, ORACLE, Row
from robosac.evaluation.comparison.settings import NOBODY, Extent

TEXT = """# Defences against attacks

`{command}`: {scenes} test sequences of {frames} frames at 5 Hz, car-1 the ego, attackers drawn among its five
teammates. In each setting all defences meet the same frames. *Oracle* fuses everybody who is honest in the frame. All
figures are in `comparison.csv`. Passes are fused ones; that of the ego alone comes on top.
"""


def write_comparison(rows: Sequence[Row], extent: Extent, out: Path, command: str) -> Path:
    """Write ``comparison.md``, ``comparison.csv``, ``precision.png`` and ``passes.png`` into a folder.

    Returns
    -------
    Path
        Of the Markdown page.
    """
    _write_csv(rows, out / "comparison.csv")
    _draw_precision(rows, out / "precision.png")
    _draw_passes(rows, out / "passes.png")
    text = TEXT.format(command=command, scenes=extent.scenes, frames=extent.frames)
    parts = [
        text,
        _pivot("AP at IoU 0.5 / 0.7", rows, lambda row: f"{row.ap50:.3f} / {row.ap70:.3f}"),
        "![AP at IoU 0.7, and what is lost against the oracle](precision.png)\n",
        _pivot(
            f"Fused passes a frame: first / 2 to {EARLY} / later",
            rows,
            lambda row: f"{row.passes_first:.1f} / {row.passes_early:.1f} / {row.passes_steady:.1f}",
        ),
        "![Precision against passes](passes.png)\n",
        _pivot("Share of frames with an attacking message in the answer", rows, lambda row: f"{row.infiltrated:.2f}"),
        _pivot("Share of honest messages left out", rows, lambda row: _number(row.honest_refused)),
    ]
    quiet = [row for row in rows if row.setting == NOBODY]
    if quiet:
        parts.append(_quiet_table(quiet))
    naming = [row for row in rows if row.honest_named is not None]
    if naming:
        parts.append(
            _pivot(
                "Naming: sequences with all attackers named / frames it took / honest teammates named",
                naming,
                lambda row: " / ".join(map(_number, (row.named_all, row.frames_to_name, row.honest_named))),
            )
        )
    path = out / "comparison.md"
    path.write_text("\n".join(parts))
    return path


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _pivot(title: str, rows: Sequence[Row], cell: Callable[[Row], str]) -> str:
    """A table with a line for each setting and a column for each defence."""
    names = list(dict.fromkeys(row.defense for row in rows))
    settings = list(dict.fromkeys(row.setting for row in rows))
    cells = {(row.setting, row.defense): cell(row) for row in rows}
    lines = [f"## {title}", "", "| attack | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for setting in settings:
        lines.append(f"| {setting.label} | " + " | ".join(cells.get((setting, n), "") for n in names) + " |")
    return "\n".join([*lines, ""])


def _quiet_table(rows: Sequence[Row]) -> str:
    """What each defence costs when nobody attacks."""
    ideal = next(row for row in rows if row.defense == ORACLE)
    lines = [
        "## What it costs when nobody attacks",
        "",
        "| defence | AP50 lost | AP70 lost | passes, later frames | honest messages left out |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        lost = f"{ideal.ap50 - row.ap50:.3f} | {ideal.ap70 - row.ap70:.3f}"
        lines.append(f"| {row.defense} | {lost} | {row.passes_steady:.2f} | {_number(row.honest_refused)} |")
    return "\n".join([*lines, ""])


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    names = [f.name for f in fields(Row) if f.name not in ("setting", "defense")]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["campaign", "attackers", "defense", *names])
        for row in rows:
            values = [getattr(row, name) for name in names]
            rounded = ["" if value is None else round(value, 4) for value in values]
            writer.writerow([row.setting.campaign, row.setting.attackers, row.defense, *rounded])


def _draw_precision(rows: Sequence[Row], path: Path) -> None:
    """AP70 of each defence in each setting as numbers, coloured by the loss against the oracle."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import, and only pictures need it)

    names = [name for name in dict.fromkeys(row.defense for row in rows) if name != ORACLE]
    settings = list(dict.fromkeys(row.setting for row in rows))
    ap = {(row.setting, row.defense): row.ap70 for row in rows}
    loss = np.array([[ap[s, ORACLE] - ap[s, n] for n in names] for s in settings])
    figure = Figure(figsize=(1.8 + 1.15 * len(names), 1.6 + 0.34 * len(settings)), layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(loss, cmap="OrRd", vmin=0.0, vmax=max(0.5, float(loss.max())), aspect="auto")
    for i, setting in enumerate(settings):
        for j, name in enumerate(names):
            colour = "white" if loss[i, j] > 0.3 else "black"
            axes.text(j, i, f"{ap[setting, name]:.2f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=8)
    axes.set_yticks(range(len(settings)), [setting.label for setting in settings], fontsize=8)
    axes.set_title("AP at IoU 0.7; colour: lost against the oracle", fontsize=9)
    figure.colorbar(image, ax=axes)
    figure.savefig(path, dpi=110)


def _draw_passes(rows: Sequence[Row], path: Path) -> None:
    """Each defence's mean AP70 over the settings with attackers against its fused passes in later frames."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import, and only pictures need it)

    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for name in dict.fromkeys(row.defense for row in rows):
        mine = [row for row in rows if row.defense == name and row.setting != NOBODY]
        if not mine:
            continue
        x = float(np.mean([row.passes_steady for row in mine]))
        y = float(np.mean([row.ap70 for row in mine]))
        marker = "x" if name in (ORACLE, EGO_ONLY) else "o"
        axes.scatter([x], [y], marker=marker)
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(5, 4), fontsize=8)
    axes.set_xlabel(f"fused passes a frame, after the first {EARLY}")
    axes.set_ylabel("AP at IoU 0.7, mean over the attacks")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
