"""Lines over the frames of a sequence, one for each teammate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from robosac.pictures import above

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = (above.BLUE, above.GREEN, above.PURPLE, above.ORANGE, above.SKY, "#000000")
STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)), (0, (2, 1)))


def team_lines(axes: Axes, values: Mapping[str, Sequence[float]], attackers: Sequence[str]) -> None:
    """A line for each teammate, those that attack in vermillion and thicker; each has a colour and style of its own."""
    honest = [name for name in values if name not in attackers]
    for number, name in enumerate(honest):
        colour, style = COLOURS[number % len(COLOURS)], STYLES[number % len(STYLES)]
        axes.plot(values[name], color=colour, linestyle=style, linewidth=1.6, label=name)
    for number, name in enumerate(name for name in values if name in attackers):
        style = STYLES[number % len(STYLES)]
        axes.plot(values[name], color=above.VERMILLION, linestyle=style, linewidth=2.8, label=f"{name}*")


def whole_frames(axes: Axes) -> None:
    """Ticks at whole numbers only."""
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415 (a second to import, and only pictures need it)

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
