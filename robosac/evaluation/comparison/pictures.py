"""Pictures of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE
from robosac.evaluation.comparison.rows import EARLY, Row
from robosac.evaluation.comparison.settings import NOBODY
from robosac.figures import new_figure, save_figure


def draw_precision(rows: Sequence[Row], path: Path) -> None:
    """AP70 of each defence in each setting as numbers, coloured by the loss against the oracle."""
    names = [name for name in dict.fromkeys(row.defense for row in rows) if name != ORACLE]
    settings = list(dict.fromkeys(row.setting for row in rows))
    ap = {(row.setting, row.defense): row.whole.ap70.value for row in rows}
    loss = np.array([[ap[s, ORACLE] - ap[s, n] for n in names] for s in settings])
    figure = new_figure(1.8 + 1.15 * len(names), 1.6 + 0.34 * len(settings))
    axes = figure.add_subplot()
    most = max(0.5, float(loss.max()))
    image = axes.imshow(loss, cmap="OrRd", vmin=0.0, vmax=most, aspect="auto")
    for i, setting in enumerate(settings):
        for j, name in enumerate(names):
            colour = "white" if loss[i, j] > 0.6 * most else "black"
            axes.text(j, i, f"{ap[setting, name]:.2f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=8)
    axes.set_yticks(range(len(settings)), [setting.label for setting in settings], fontsize=8)
    axes.set_title("AP at IoU 0.7; colour: lost against the oracle", fontsize=9)
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
