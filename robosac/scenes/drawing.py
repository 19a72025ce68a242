"""Pictures of scenes seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robosac.answers import FrameAnswer, Standing
from robosac.boxes import FloatArray, corners, from_world
from robosac.figures import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from robosac.scenes.intersection import SceneFrame

VIEW_M = 32.0
TRUE_COLOUR = "#1b7837"
HIDDEN_COLOUR = "#e08214"
FOUND_COLOUR = "#2166ac"
STANDING_COLOURS: Mapping[Standing, str] = {
    Standing.CONFIRMED: "#0072b2",
    Standing.SINGLE_WITNESS: "#e69f00",
    Standing.DISPUTED: "#cc79a7",
    Standing.REPAIRED: "#56b4e9",
    Standing.CONTRADICTED: "#d55e00",
}
"""Of the palette by M. Okabe and K. Ito (Color Universal Design, 2008), which the colour-blind can tell apart."""


def draw_points(axes: Axes, points: FloatArray) -> None:
    """LiDAR returns (P, 3), coloured by height."""
    axes.scatter(points[:, 0], points[:, 1], s=0.4, c=points[:, 2], cmap="Greys_r", vmin=-2.5, vmax=4.0, linewidths=0)


def draw_boxes(
    axes: Axes, boxes: FloatArray, colour: str, label: str, *, dashed: bool = False, width: float = 1.4
) -> None:
    """Boxes (n, 5+) as outlines; the legend gets one entry, with their number."""
    style = "--" if dashed else "-"
    for i, outline in enumerate(corners(boxes)):
        closed = np.vstack([outline, outline[:1]])
        text = f"{label} ({len(boxes)})" if i == 0 else None
        axes.plot(closed[:, 0], closed[:, 1], style, color=colour, linewidth=width, label=text)


def draw_answer(axes: Axes, answer: FrameAnswer, least_score: float) -> None:
    """Boxes of an answer from a score on, coloured by how they stand, where that is known; contradicted ones dashed."""
    boxes, support = answer.boxes, answer.support
    if support is None:
        draw_boxes(axes, boxes[boxes[:, 5] >= least_score], FOUND_COLOUR, "found")
        return
    out = np.array([box.box for box in answer.contradicted or ()]).reshape(-1, 6)
    everything = np.vstack([boxes, out])
    standings = [each.status for each in (*support, *(answer.contradicted or ()))]
    for standing, colour in STANDING_COLOURS.items():
        of_it = everything[[each is standing for each in standings]]
        contradicted = standing is Standing.CONTRADICTED
        confident = of_it[of_it[:, 5] >= least_score]
        draw_boxes(axes, confident, colour, standing.value.replace("_", " "), dashed=contradicted, width=1.8)


def frame_axes(axes: Axes, title: str, viewer: str = "ego") -> None:
    """Limits, labels and legend of one bird's eye view."""
    axes.plot(0.0, 0.0, marker="^", color="black", markersize=9, linestyle="none", label=viewer)
    axes.set(
        xlim=(-VIEW_M, VIEW_M), ylim=(-VIEW_M, VIEW_M), aspect="equal", title=title, xlabel="x (m)", ylabel="y (m)"
    )
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=4, fontsize="small", frameon=False)


def draw_view(frame: SceneFrame, agent: str, path: Path, title: str = "") -> tuple[int, int]:
    """Draw what one agent senses, the true boxes, and which of them it cannot see itself.

    Parameters
    ----------
    frame : SceneFrame
    agent : str
    path : Path
        The picture; its suffix chooses the format.
    title : str
        What the picture's title begins with.

    Returns
    -------
    seen, hidden : int
        True boxes that the agent hits at least 6 times itself, and those that only its teammates do.

    Raises
    ------
    KeyError
        If the frame has no such agent.
    """
    from robosac.scenes.intersection import TRUTH_MIN_HITS  # noqa: PLC0415 (would be circular)

    view = frame.views[agent]
    boxes, index = frame.nearby(agent)
    everyone = np.max([v.hits for v in frame.views.values()], axis=0)[index]
    own = view.hits[index]
    seen, hidden = boxes[own >= TRUTH_MIN_HITS], boxes[(own < TRUTH_MIN_HITS) & (everyone >= TRUTH_MIN_HITS)]
    figure = new_figure(9, 9)
    axes = figure.add_subplot()
    draw_points(axes, view.points)
    draw_boxes(axes, seen, TRUE_COLOUR, "seen by the agent")
    draw_boxes(axes, hidden, HIDDEN_COLOUR, "hidden from it, seen by a teammate", dashed=True)
    others = [v.pose[:2, 3] for name, v in frame.views.items() if name != agent]
    if others:
        places = from_world(np.column_stack([np.array(others), np.ones((len(others), 3))]), view.pose)
        axes.plot(places[:, 0], places[:, 1], "s", color="#762a83", markersize=6, linestyle="none", label="teammate")
    heading = f"{title}frame {frame.index}, {agent}: {len(seen)} vehicles seen, {len(hidden)} hidden"
    frame_axes(axes, heading, viewer=agent)
    save_figure(figure, path, dpi=110)
    return len(seen), len(hidden)
