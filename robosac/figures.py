"""Figures to draw on, by matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robosac.extras import need

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
