"""Recordings seen from above: pictures, one a frame, and moving ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robosac.boxes import from_world
from robosac.figures import check_film, new_figure, save_figure
from robosac.files import replacing
from robosac.recording.reading import RecordedFrame, RecordedSession
from robosac.scenes.drawing import TRUE_COLOUR, VIEW_M, draw_answer, draw_boxes, frame_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TAKEN, _LEFT_OUT = "#762a83", "#d55e00"
_INCHES, _DPI = 8.0, 80


def write_pictures(session: RecordedSession, folder: Path, least_score: float, tick: Callable[[], None]) -> None:
    """Draw each frame as ``FRAME.png`` into a folder; boxes count from a score on. ``tick`` is called after each."""
    for frame in session.frames:
        figure = new_figure(_INCHES, _INCHES)
        draw_recorded(figure.add_subplot(), frame, session.opening.ego_id, least_score)
        save_figure(figure, folder / f"{frame.number:06d}.png", dpi=_DPI)
        tick()


def write_moving(session: RecordedSession, path: Path, least_score: float, tick: Callable[[], None]) -> None:
    """Draw all frames into a GIF, or into an MP4 where there is ffmpeg, at the session's frame rate.

    Raises
    ------
    MissingExtra, ValueError
        As `robosac.figures.check_film`.
    """
    check_film(path)
    from matplotlib.animation import FFMpegWriter, PillowWriter  # noqa: PLC0415 (a second to import)
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

    video = path.suffix.lower() == ".mp4"
    writer: Any = (FFMpegWriter if video else PillowWriter)(fps=max(1, round(1e3 / session.opening.frame_period_ms)))
    figure = new_figure(_INCHES, _INCHES)
    FigureCanvasAgg(figure)
    with replacing(path) as beside, writer.saving(figure, str(beside), _DPI):
        for frame in session.frames:
            figure.clear()
            draw_recorded(figure.add_subplot(), frame, session.opening.ego_id, least_score)
            writer.grab_frame()
            tick()


def draw_recorded(axes: Axes, frame: RecordedFrame, ego_id: str, least_score: float) -> None:
    """Draw certain boxes, true ones where they were recorded, and the teammates; all in the ego's frame."""
    answer, pose = frame.answer, frame.poses[ego_id]
    if (truth := frame.true_boxes) is not None:
        draw_boxes(axes, truth, TRUE_COLOUR, "true", dashed=True, width=1.0)
    draw_answer(axes, answer, least_score)
    others = [name for name in frame.poses if name != ego_id]
    for label, colour, marker, names in (
        ("accepted", _TAKEN, "s", [name for name in others if name in answer.accepted]),
        ("left out", _LEFT_OUT, "X", [name for name in others if name not in answer.accepted]),
    ):
        if names:
            _draw_teammates(axes, frame, names, pose, label, colour, marker)
    who = ", ".join(answer.accepted) or "nobody"
    frame_axes(axes, f"frame {frame.number}: {answer.source.value.replace('_', ' ')} of {who}", viewer=ego_id)


def _draw_teammates(
    axes: Axes, frame: RecordedFrame, names: Sequence[str], pose: Any, label: str, colour: str, marker: str
) -> None:
    there = np.array([[*frame.poses[name][:2, 3], 0.0, 0.0, 0.0] for name in names])
    here = from_world(there, pose)
    axes.plot(here[:, 0], here[:, 1], marker, color=colour, markersize=8, linestyle="none", label=label)
    for name, (x, y, *_) in zip(names, here, strict=True):
        if max(abs(x), abs(y)) <= VIEW_M:
            axes.annotate(name, (x, y), xytext=(6, 6), textcoords="offset points", fontsize="small", color=colour)
