"""A sequence under attack as a film: what is seen without a defence, and what with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robosac.boxes import FloatArray
from robosac.consensus import match
from robosac.figures import new_figure, save_film
from robosac.pictures import above
from robosac.pictures.lines import team_lines, whole_frames
from robosac.pictures.moments import Moment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FOUND_IOU = 0.3
"""From here on a box shows a true vehicle."""
SIZE = (9.6, 6.0)
DPI = 75


def draw_film(moments: Sequence[Moment], path: Path, title: str, defense: str, *, fps: int) -> None:
    """Draw a film: the fusion of everybody on the left, the defence's answers on the right, suspicion below.

    Parameters
    ----------
    moments : sequence of Moment
    path : Path
        Ends with ``.gif`` or ``.mp4``.
    title : str
        What stands above it.
    defense : str
        What the defence is called.
    fps : int
        Frames a second.
    """
    figure = new_figure(*SIZE)

    def draw(number: int) -> None:
        draw_moment(figure, moments, number, title, defense)

    save_film(figure, draw, len(moments), path, fps=fps, dpi=DPI)


def draw_moment(figure: Figure, moments: Sequence[Moment], number: int, title: str, defense: str) -> None:
    """Draw the film's frame of a number into an empty figure; the other parameters are those of `draw_film`."""
    moment = moments[number]
    knows = moment.result.suspicion is not None
    figure.suptitle(f"{title}; frame {number}", fontsize=11)
    grid = figure.add_gridspec(2, 2, height_ratios=(5, 1) if knows else (1, 0.001))
    left, right = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    _seen(left, moment, moment.fused(*moment.met.team), "no defence", "everybody is fused", defended=False)
    out = [f"{name} ({_why(moment, name)})" for name in moment.met.team if name not in moment.result.accepted]
    _seen(right, moment, moment.found, defense, f"left out: {', '.join(out) or 'nobody'}", defended=True)
    if knows:
        _suspicion(figure.add_subplot(grid[1, :]), moments, number)
    keys = [above.key_of_truth(), above.key_of_line(above.FOUND), above.key_of_line(above.FALSE)]
    keys += above.keys_of_vehicles()
    figure.legend(handles=keys, loc="outside lower center", ncols=6, fontsize=8, frameon=False)


def _seen(axes: Axes, moment: Moment, boxes: FloatArray, title: str, said: str, *, defended: bool) -> None:
    above.prepare(axes, moment)
    truth = moment.met.truth
    rows, columns = match(truth, boxes, FOUND_IOU)
    false = np.setdiff1d(np.arange(len(boxes)), columns)
    above.boxes(axes, boxes[columns], above.FOUND)
    above.boxes(axes, boxes[false], above.FALSE)
    if defended:
        above.team(axes, moment, silent=True)
    axes.set_title(title, fontsize=11, fontweight="bold")
    axes.set_xlabel(f"{len(rows)} of {len(truth)} found, {len(false)} not there\n{said}", fontsize=9)


def _why(moment: Moment, name: str) -> str:
    if name in moment.named:
        return "named"
    return moment.answer.rejected[name].reason.value.replace("_", " ")


def _suspicion(axes: Axes, moments: Sequence[Moment], number: int) -> None:
    """Of each teammate up to now."""
    names = sorted({name for moment in moments for name in moment.met.team})
    values = {name: [_of(moment, name) for moment in moments[: number + 1]] for name in names}
    team_lines(axes, values, sorted({name for moment in moments for name in moment.met.attackers}))
    axes.set(xlim=(-0.5, len(moments) - 0.5), ylim=(-0.05, 1.05), yticks=(0, 1))
    axes.set_title("suspicion; * attacks", fontsize=9, loc="left")
    axes.tick_params(labelsize=8)
    whole_frames(axes)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=2, fontsize=8, frameon=False)


def _of(moment: Moment, name: str) -> float:
    return (moment.result.suspicion or {}).get(name, float("nan"))
