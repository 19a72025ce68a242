"""Scenes of one's own, whose frames are checked as they are read.

Boxes with a column too many or a pose that is no pose would not stop an evaluation: they would make its figures wrong.
So what a foreign source gives is looked at wherever a frame of it is read, and what has a wrong form is an error that
says where it stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, pose_fault
from robosac.scenes.base import Frame, Scene, SceneAround, SceneError, SceneSource, Split, View

BOX_COLUMNS = 5
MOST_YAW = 4 * math.pi
"""No heading in radians is beyond this, however it was added up; one in degrees soon is."""
_FEW = 100
"""Returns that are looked at first, since of most views one of them is finite."""


@dataclass(frozen=True)
class CheckedFrame:
    """A frame whose views have been checked, and whose true boxes are checked when they are asked for."""

    original: Frame
    where: str
    """Source, scene and frame, for messages."""

    @property
    def index(self) -> int:
        """That of the original."""
        return self.original.index

    @property
    def views(self) -> Mapping[str, View]:
        """Those of the original."""
        return self.original.views

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5) of the original.

        Raises
        ------
        SceneError
            If they have another shape, one is not finite, has no size or seems to be in degrees, or they cannot be had.
        """
        part = f"truth({ego!r})"
        with _said(f"{self.where}: {part}"):
            boxes = self.original.truth(ego)
        if _shape(boxes) == (0,):
            return np.empty((0, BOX_COLUMNS))
        if not isinstance(boxes, np.ndarray) or boxes.ndim != 2 or boxes.shape[1] != BOX_COLUMNS:
            raise SceneError(f"{self.where}: {part} must be (G, {BOX_COLUMNS}), got {_shown(boxes)}")
        if not _finite(boxes).all():
            raise SceneError(f"{self.where}: {part} must be finite numbers")
        if (boxes[:, 2:4] <= 0).any():
            raise SceneError(f"{self.where}: {part} must have positive lengths and widths, got {boxes[:, 2:4].min():g}")
        if (np.abs(boxes[:, 4]) > MOST_YAW).any():
            yaw = boxes[np.abs(boxes[:, 4]).argmax(), 4]
            raise SceneError(f"{self.where}: {part} must have yaws in radians, got {yaw:g}: is it in degrees?")
        return boxes

    def __getattr__(self, name: str) -> Any:
        if name in ("original", "where"):  # not there yet, while it is unpickled
            raise AttributeError(name)
        return getattr(self.original, name)


@dataclass(frozen=True)
class CheckedScene(SceneAround):
    """A scene whose frames are checked."""

    source: str
    """Its source's name, for messages."""

    @property
    def agents(self) -> Sequence[str]:
        """Those of the original.

        Raises
        ------
        SceneError
            If they are no ids.
        """
        return self._ids("agents", self.scene.agents)

    @property
    def egos(self) -> Sequence[str]:
        """Those of the original.

        Raises
        ------
        SceneError
            If they are no ids of agents.
        """
        egos = self._ids("egos", self.scene.egos)
        if not set(self.scene.agents).issuperset(egos):
            raise SceneError(f"{self._where}: egos must be some of the agents, got {egos!r}")
        return egos

    @property
    def length(self) -> int | None:
        """That of the original.

        Raises
        ------
        SceneError
            If it is no number of frames.
        """
        length = self.scene.length
        if length is not None and (not isinstance(length, Integral) or isinstance(length, bool) or length < 0):
            raise SceneError(f"{self._where}: length must be a number of frames or None, got {length!r}")
        return length

    @property
    def frame_period_s(self) -> float:
        """That of the original.

        Raises
        ------
        SceneError
            If it is no time.
        """
        period_s = self.scene.frame_period_s
        if not isinstance(period_s, Real) or not 0 < period_s < math.inf:
            raise SceneError(f"{self._where}: frame_period_s must be a positive number of seconds, got {period_s!r}")
        return float(period_s)

    @property
    def _where(self) -> str:
        return f"{self.source}, scene {self.number}"

    def _ids(self, part: str, ids: Sequence[str]) -> Sequence[str]:
        is_some = isinstance(ids, Sequence) and not isinstance(ids, str) and len(ids) > 0
        if not is_some or not all(isinstance(each, str) for each in ids):
            raise SceneError(f"{self._where}: {part} must be a sequence of one or more ids, got {ids!r:.200}")
        if len(set(ids)) < len(ids):
            raise SceneError(f"{self._where}: {part} must be distinct, got {ids!r:.200}")
        return ids

    def frame(self, index: int) -> Frame:
        """A frame of the scene, its views checked.

        Raises
        ------
        SceneError
            If it cannot be had, or a view has not the form that it must have.
        """
        where = f"{self._where}, frame {index}"
        with _said(where):
            frame = self.scene.frame(index)
            if frame.index != index:
                raise SceneError(f"index must be the one that is asked for, got {frame.index!r:.100}")
            agents = set(self.scene.agents)
            if strangers := frame.views.keys() - agents:
                raise SceneError(f"{min(strangers, key=str)!r} has a view, and is no agent of the scene")
            hostile = getattr(frame, "attackers", ())
            if isinstance(hostile, str) or not agents.issuperset(hostile):
                raise SceneError(f"attackers must be some of the agents, got {hostile!r:.200}")
            for name, view in frame.views.items():
                fault = view_fault(view) if hasattr(view, "pose") else f"must be a View, got a {type(view).__name__}"
                if fault is not None:
                    raise SceneError(f"{name}: {fault}")
        return CheckedFrame(frame, where)


class CheckedSource:
    """A source whose scenes are checked; it keeps scenes for training if the original does."""

    def __init__(self, original: SceneSource) -> None:
        self.original = original
        keep: Callable[[], Sequence[Scene]] | None = getattr(original, "training_scenes", None)
        if keep is not None:
            self.training_scenes = self._training_scenes

    @property
    def name(self) -> str:
        """That of the original.

        Raises
        ------
        SceneError
            If it is no text.
        """
        name: object = self.original.name
        if not isinstance(name, str) or not name:
            raise SceneError(f"the name of a scene source must be a text, got {name!r:.100}")
        return name

    def scenes(self, split: Split) -> Sequence[Scene]:
        """Those of the original, in its order."""
        with _said(self.name):
            return _checked(self.original.scenes(split), self.name)

    def _training_scenes(self) -> Sequence[Scene]:
        with _said(self.name):
            kept: Sequence[Scene] = self.original.training_scenes()  # type: ignore[attr-defined]
            return _checked(kept, self.name)


def _checked(scenes: Iterable[Scene], source: str) -> list[Scene]:
    known: set[int] = set()
    checked: list[Scene] = []
    for scene in scenes:
        number = scene.number
        if not isinstance(number, Integral) or number < 0:
            raise SceneError(f"a scene's number must be an integer, not negative, got {number!r}")
        if number in known:
            raise SceneError(f"two scenes have the number {number}")
        known.add(number)
        checked.append(CheckedScene(scene, source))
    return checked


def view_fault(view: View) -> str | None:
    """What is wrong with a view's form; None if nothing is.

    Some returns may be no numbers, as scanners have it where nothing came back; all of them may not. Of a view with
    the message that was sent only the pose counts.
    """
    pose, points = view.pose, view.points
    if _shape(pose) != (4, 4) or not _finite(pose).all():
        got = "some that are not" if _shape(pose) == (4, 4) else _shown(pose)
        return f"pose must be 4 x 4 finite numbers, got {got}"
    fault = pose_fault(pose)
    if fault is not None:
        return f"pose {fault}"
    if getattr(view, "message", None) is not None:
        return None
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] < 3:
        return f"points must be (P, 3), got {_shown(points)}"
    if len(points) and not any(_finite(some[:, :3]).all(axis=1).any() for some in (points[:_FEW], points)):
        return "points must be finite numbers, and none is"
    return None


@contextmanager
def _said(where: str) -> Iterator[None]:
    """Say of whatever goes wrong where it did."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from error
    except Exception as error:  # the user's code may raise anything
        said = " ".join(str(error).split())
        raise SceneError(f"{where}: {type(error).__name__}: {said}") from error


def _finite(array: Any) -> Any:
    """Which entries are finite numbers; none of what holds no numbers."""
    return np.isfinite(array) if array.dtype.kind in "fiu" else np.zeros(array.shape, dtype=bool)


def _shape(value: object) -> tuple[int, ...] | None:
    return value.shape if isinstance(value, np.ndarray) else None


def _shown(value: object) -> str:
    return str(value.shape) if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
