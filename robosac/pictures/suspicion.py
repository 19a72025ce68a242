"""A sequence at a glance: suspicion of each teammate over time, and who was fused and who named in which frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from robosac.figures import new_figure, save_figure
from robosac.pictures import above
from robosac.pictures.lines import team_lines, whole_frames
from robosac.pictures.moments import Moment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FUSED, LEFT_OUT, NAMED = (("fused", above.SKY, "o"), ("left out", above.ORANGE, "X"), ("named", above.VERMILLION, "s"))
"""What became of a teammate in a frame: words, colour and marker."""
ATTACKS = "#e8e8e8"
DPI = 110


def draw_suspicion(moments: Sequence[Moment], path: Path, title: str) -> None:
    """Write the picture of a sequence; the suffix chooses the format."""
    save_figure(suspicion_figure(moments, title), path, dpi=DPI)


def suspicion_figure(moments: Sequence[Moment], title: str) -> Figure:
    """Draw suspicion over time, if the defence knows it, and below what became of each teammate in each frame.

    Parameters
    ----------
    moments : sequence of Moment
    title : str
        What stands above it.
    """
    names = sorted({name for moment in moments for name in moment.met.team})
    attackers = sorted({name for moment in moments for name in moment.met.attackers})
    knows = any(moment.result.suspicion is not None for moment in moments)
    figure = new_figure(max(7.0, 3.0 + 0.28 * len(moments)), (3.2 if knows else 0.8) + 0.35 * len(names) + 1.0)
    figure.suptitle(title, fontsize=11)
    ratios = (2.8, 0.35 * len(names)) if knows else (0.35 * len(names),)
    parts = figure.subplots(len(ratios), 1, height_ratios=ratios, sharex=True, squeeze=False).ravel()
    if knows:
        values = {name: [_of(moment, name) for moment in moments] for name in names}
        team_lines(parts[0], values, attackers)
        parts[0].set(ylim=(-0.03, 1.03), ylabel="suspicion")
        parts[0].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)
    _fates(parts[-1], moments, names, attackers)
    return figure


def _fates(axes: Axes, moments: Sequence[Moment], names: Sequence[str], attackers: Sequence[str]) -> None:
    """What became of each teammate in each frame; behind it whether it attacked."""
    for row, name in enumerate(names):
        struck = [(moment.number - 0.5, 1) for moment in moments if name in moment.met.attackers]
        axes.broken_barh(struck, (row - 0.45, 0.9), facecolors=ATTACKS, zorder=0)
        for fate in (FUSED, LEFT_OUT, NAMED):
            when = [moment.number for moment in moments if _fate(moment, name) == fate]
            _, colour, marker = fate
            axes.plot(when, [row] * len(when), linestyle="none", marker=marker, color=colour, markersize=7)
    axes.set(xlim=(-0.5, len(moments) - 0.5), ylim=(len(names) - 0.5, -0.5), xlabel="frame", yticks=range(len(names)))
    whole_frames(axes)
    axes.set_yticklabels([f"{name}*" if name in attackers else name for name in names], fontsize=9)
    axes.legend(handles=_keys(), loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)


def _fate(moment: Moment, name: str) -> tuple[str, str, str] | None:
    if name not in moment.met.team:
        return None
    if name in moment.result.accepted:
        return FUSED
    return NAMED if name in moment.named else LEFT_OUT


def _of(moment: Moment, name: str) -> float:
    return (moment.result.suspicion or {}).get(name, float("nan"))


def _keys() -> list[object]:
    from matplotlib.lines import Line2D  # noqa: PLC0415 (a second to import, and only pictures need it)
    from matplotlib.patches import Patch  # noqa: PLC0415 (as above)

    marks = [
        Line2D([], [], linestyle="none", marker=marker, color=colour, label=label)
        for label, colour, marker in (FUSED, LEFT_OUT, NAMED)
    ]
    return [*marks, Patch(facecolor=ATTACKS, label="* attacks")]
