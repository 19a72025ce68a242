"""Figures to draw on, by matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from robosac.extras import need
from robosac.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def need_figures() -> None:
    """Refuse before long work if its pictures cannot be drawn.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need("matplotlib", "pictures")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches; its parts are laid out so that they do not overlap.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need_figures()
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import, and only pictures need it)

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: int, **options: Any) -> None:
    """Write a picture by `replacing`; the suffix chooses the format. ``options`` are those of ``Figure.savefig``."""
    with replacing(path) as beside:
        figure.savefig(beside, dpi=dpi, **options)
