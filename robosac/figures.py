"""Figures to draw on, by matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robosac.extras import need

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def need_figures() -> None:
    """See to it before long work that its pictures can be drawn.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need("matplotlib", "pictures")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, whose parts make room for one another.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need_figures()
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import, and only pictures need it)

    return Figure(figsize=(width, height), layout="constrained")
