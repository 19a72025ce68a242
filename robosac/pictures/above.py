"""What there is to see from above, drawn layer by layer: vehicles, boxes, evidence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robosac.answers import Standing
from robosac.boxes import FloatArray, corners, from_world
from robosac.defenses import Difference
from robosac.pictures.moments import Moment
from robosac.scenes.drawing import STANDING_COLOURS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7", "#56b4e9"
TRUE = "#c9c9c9"
INK = "#222222"
EDGE = 0.95
"""Vehicles farther away are drawn at the edge, at this share of the view."""


@dataclass(frozen=True)
class Line:
    """How boxes of one layer are drawn."""

    label: str
    colour: str
    style: Any = "-"
    width: float = 2.0
    crossed: bool = False


STANDINGS: Mapping[Standing, Line] = {
    Standing.CONFIRMED: Line("confirmed", STANDING_COLOURS[Standing.CONFIRMED]),
    Standing.SINGLE_WITNESS: Line("single witness", STANDING_COLOURS[Standing.SINGLE_WITNESS], (0, (5, 1.5))),
    Standing.DISPUTED: Line("disputed", STANDING_COLOURS[Standing.DISPUTED], (0, (5, 1.5, 1, 1.5))),
    Standing.REPAIRED: Line("repaired", STANDING_COLOURS[Standing.REPAIRED], (0, (2, 1)), 2.8),
    Standing.CONTRADICTED: Line("contradicted", STANDING_COLOURS[Standing.CONTRADICTED], (0, (3, 2)), crossed=True),
}
ANSWERED = Line("answered", BLUE)
OWN = Line("ego alone", GREEN, (0, (1, 1.5)), 1.6)
FOUND = Line("found", BLUE, width=1.8)
FALSE = Line("not there", VERMILLION, (0, (3, 1.5)), crossed=True, width=1.8)
FUSED = Line("fused", INK, width=0.9)
LIE = Line("the adversary's lie", INK, (0, (1, 1)), 1.2)
MARKS: Mapping[str, tuple[str, str, str]] = {
    "lost": ("x", VERMILLION, "lost"),
    "moved": ("D", ORANGE, "moved"),
    "added": ("P", PURPLE, "added"),
    "came": ("^", SKY, "came since before"),
    "gone": ("v", BLUE, "gone since before"),
    "invented": ("*", VERMILLION, "invented"),
    "removed": ("X", VERMILLION, "removed"),
    "displaced": ("s", VERMILLION, "displaced"),
    "reshaped": ("h", VERMILLION, "reshaped"),
}
"""Marker, colour and label of evidence on a box, by what happened there. Open markers, but those of objects."""
BLAMED = ("invented", "removed", "displaced", "reshaped")


def prepare(axes: Axes, moment: Moment, *, true: bool = True) -> None:
    """An empty view of the detector's area: the true vehicles in grey, the ego as an arrow."""
    from matplotlib.collections import PolyCollection  # noqa: PLC0415 (a second to import, and only pictures need it)

    xmin, ymin, xmax, ymax = moment.met.info.area_m
    axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal", xticks=[], yticks=[])
    if true:
        outlines = corners(moment.met.truth)
        axes.add_collection(PolyCollection(list(outlines), facecolors=TRUE, edgecolors="none", zorder=1))
    _arrow(axes, 0.0, 0.0, 0.0, INK, filled=True, size=11)


def boxes(axes: Axes, which: FloatArray, line: Line, zorder: float = 3) -> None:
    """Boxes (n, 5+) as outlines."""
    from matplotlib.collections import LineCollection, PolyCollection  # noqa: PLC0415 (see `prepare`)

    if not len(which):
        return
    outlines = corners(which)
    style: dict[str, Any] = {"linewidths": line.width, "linestyles": [line.style], "zorder": zorder}
    axes.add_collection(PolyCollection(list(outlines), facecolors="none", edgecolors=line.colour, **style))
    if line.crossed:
        ends = [each for outline in outlines for each in (outline[[0, 2]], outline[[1, 3]])]
        axes.add_collection(LineCollection(ends, colors=line.colour, linewidths=line.width * 0.5, zorder=zorder))


def answered(axes: Axes, moment: Moment) -> None:
    """The boxes of the answer by how they stand, and those that were left out."""
    answer, least = moment.answer, moment.met.info.consensus_score
    if answer.support is None:
        boxes(axes, moment.found, ANSWERED)
        return
    out = np.array([left.box for left in answer.contradicted or ()]).reshape(-1, 6)
    everything = np.vstack([answer.boxes, out])
    standings = [each.status for each in (*answer.support, *(answer.contradicted or ()))]
    for standing, line in STANDINGS.items():
        of_it = everything[[each is standing for each in standings]]
        boxes(axes, of_it[of_it[:, 5] >= least], line)


def team(axes: Axes, moment: Moment, *, silent: bool = False) -> None:
    """Teammates where they claim to be; whoever is beyond the view stands at its edge, with the distance."""
    poses = {name: message.pose for name, message in moment.met.teammates.items()}
    if not poses:
        return
    there = np.array([[p[0, 3], p[1, 3], 1.0, 1.0, np.arctan2(p[1, 0], p[0, 0])] for p in poses.values()])
    here = from_world(there, moment.met.ego.pose)
    half = np.abs(np.array([axes.get_xlim(), axes.get_ylim()])).min() * EDGE
    for name, (x, y, _, _, yaw) in zip(poses, here, strict=True):
        beyond = max(abs(x), abs(y)) / half
        at_x, at_y = (x, y) if beyond <= 1 else (x / beyond, y / beyond)
        named, accepted = name in moment.named, name in moment.result.accepted
        _arrow(axes, at_x, at_y, yaw, VERMILLION if named else INK, filled=accepted, size=10)
        if silent:
            continue
        what = ", named" if named else "" if accepted else ", left out"
        away = f", {np.hypot(x, y):.0f} m" if beyond > 1 else ""
        star = "*" if name in moment.met.attackers else ""
        words(axes, f"{name}{star}{what}{away}", at_x, at_y, right=at_x > 0)


def words(axes: Axes, text: str, x: float, y: float, *, right: bool) -> None:
    """Words beside a place, with a white seam, so that lines below do not hide them."""
    from matplotlib.patheffects import withStroke  # noqa: PLC0415 (see `prepare`)

    axes.annotate(
        text,
        (x, y),
        xytext=(-9 if right else 9, -15 if y > 0 else 7),
        textcoords="offset points",
        ha="right" if right else "left",
        fontsize=9,
        color=INK,
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=8,
    )


def marks(axes: Axes, differences: Iterable[Difference], kinds: Iterable[str], size: float) -> set[str]:
    """Evidence on single boxes, of these kinds, each place once; the kinds that there were."""
    places: dict[str, list[FloatArray]] = {}
    for difference in differences:
        for kind, where in difference.places().items():
            places.setdefault(kind, []).append(where)
    wanted = [kind for kind in kinds if any(len(where) for where in places.get(kind, ()))]
    for kind in wanted:
        shape, colour, _ = MARKS[kind]
        where = np.unique(np.concatenate(places[kind]).round(1), axis=0)
        axes.plot(*where.T, **_marker(shape, colour, size), zorder=6)
    return set(wanted)


def _marker(shape: str, colour: str, size: float) -> dict[str, Any]:
    filled = shape in "*XP^v"
    face = colour if filled else "none"
    edge = "white" if filled else colour
    return {
        "marker": shape,
        "linestyle": "none",
        "markersize": size,
        "markerfacecolor": face,
        "markeredgecolor": edge,
        "markeredgewidth": 0.5 if filled else 1.6,
    }


def _arrow(axes: Axes, x: float, y: float, yaw: float, colour: str, *, filled: bool, size: float) -> None:
    from matplotlib.markers import MarkerStyle  # noqa: PLC0415 (see `prepare`)
    from matplotlib.path import Path  # noqa: PLC0415 (see `prepare`)

    turned = np.array([[1, 0], [-1, 0.75], [-0.5, 0], [-1, -0.75], [1, 0]])
    cos, sin = np.cos(yaw), np.sin(yaw)
    shape = MarkerStyle(Path(turned @ np.array([[cos, sin], [-sin, cos]]), closed=True))
    face = colour if filled else "white"
    axes.plot(x, y, marker=shape, markersize=size, markerfacecolor=face, markeredgecolor=colour, zorder=7)


def key_of_line(line: Line) -> Artist:
    """An entry of a legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 (see `prepare`)

    label = f"{line.label}, crossed out" if line.crossed else line.label
    return Line2D([], [], color=line.colour, linestyle=line.style, linewidth=line.width, label=label)


def key_of_mark(kind: str) -> Artist:
    """An entry of a legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 (see `prepare`)

    shape, colour, label = MARKS[kind]
    return Line2D([], [], label=label, **_marker(shape, colour, 7))


def key_of_truth() -> Artist:
    """An entry of a legend."""
    from matplotlib.patches import Patch  # noqa: PLC0415 (see `prepare`)

    return Patch(facecolor=TRUE, label="true vehicle")


def keys_of_vehicles() -> list[Artist]:
    """Entries of a legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 (see `prepare`)

    each = (("ego, teammate fused", INK, INK), ("left out", "white", INK), ("named", "white", VERMILLION))
    return [
        Line2D(
            [], [], marker=">", linestyle="none", markersize=8, markerfacecolor=face, markeredgecolor=edge, label=label
        )
        for label, face, edge in each
    ]
