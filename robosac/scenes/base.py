"""What a source of scenes is to the rest of the project.

A source has scenes, a scene has frames, and a frame has what each agent senses and the true boxes. Whatever gives these
can be calibrated on, compared on, and driven through a gateway: the synthetic intersection, recorded data, or the
user's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from robosac.boxes import FloatArray
from robosac.detectors import DetectorError, Encoder, Message
from robosac.detectors.base import misfit

Split = Literal["test", "validation"]
"""What scenes serve: defences are calibrated on validation scenes and measured on test scenes."""


class SceneError(ValueError):
    """A source does not have what is asked of it, or its data cannot be read."""


@dataclass(frozen=True)
class View:
    """What one agent senses in one frame."""

    pose: FloatArray
    """(4, 4): world_from_sensor; all agents of a scene share the world, and it stays where it is from frame to frame.
    """
    points: FloatArray
    """(P, 3): LiDAR returns in the sensor's frame, metres."""
    message: Message | None = field(default=None, kw_only=True)
    """What the agent sent, where that is known in the place of what it sensed; then it is not encoded again."""


class Frame(Protocol):
    """One instant of a scene."""

    @property
    def index(self) -> int:
        """Its number in the scene."""

    @property
    def views(self) -> Mapping[str, View]:
        """What each agent senses that is present."""

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5) for an agent: x, y, length, width, yaw in its sensor's frame, metres and radians."""


class Scene(Protocol):
    """A sequence of frames."""

    @property
    def number(self) -> int:
        """A non-negative number that no other scene of the source has: random draws and recordings go by it."""

    @property
    def agents(self) -> Sequence[str]:
        """Ids of all agents, those that may be an ego first."""

    @property
    def egos(self) -> Sequence[str]:
        """Those agents that may be an ego. The first is the ego of sequences, and present in every frame."""

    @property
    def length(self) -> int | None:
        """Number of frames; None if there is no end."""

    @property
    def frame_period_s(self) -> float:
        """Time from one frame to the next, seconds."""

    def frame(self, index: int) -> Frame:
        """The frame of a number from 0 to below ``length``."""


@dataclass(frozen=True)
class SceneAround:
    """What another scene is, but for its frames."""

    scene: Scene

    @property
    def number(self) -> int:
        return self.scene.number

    @property
    def agents(self) -> Sequence[str]:
        return self.scene.agents

    @property
    def egos(self) -> Sequence[str]:
        return self.scene.egos

    @property
    def length(self) -> int | None:
        return self.scene.length

    @property
    def frame_period_s(self) -> float:
        return self.scene.frame_period_s


@runtime_checkable
class SceneSource(Protocol):
    """Where scenes come from. It is sent to other processes where several share the work, so it has to be picklable."""

    @property
    def name(self) -> str:
        """Says which data this is; recordings and calibrations are kept under it."""

    def scenes(self, split: Split) -> Sequence[Scene]:
        """The scenes for a purpose, always in the same order. No frame is made before it is asked for."""


def encoded(view: View, detector: Encoder) -> Message:
    """An agent's message, with all that it would send as an ego: encoded, or as it was recorded.

    Raises
    ------
    SceneError
        If it was recorded for a detector of another layout.
    DetectorError
        If the detector encodes in another layout than it declares, or something that is no finite number.
    """
    recorded: Message | None = getattr(view, "message", None)
    if recorded is not None:
        if fault := misfit(recorded, detector.info):
            raise SceneError(f"of recorded messages the detector {detector.info.name} takes {fault}")
        return Message(view.pose, recorded.tensors)
    message = detector.encode(view.points, view.pose)
    if fault := misfit(message, detector.info):
        raise DetectorError(f"{detector.info.name}: encode must return {fault}")
    for name, array in message.tensors.items():
        if not np.isfinite(array).all():
            raise DetectorError(f"{detector.info.name}: encode must return finite numbers; {name} holds others")
    return message


def first_scenes(source: SceneSource, split: Split, count: int, frames: int = 1, team: int = 1) -> list[Scene]:
    """The first scenes of a source that are long enough.

    Parameters
    ----------
    source : SceneSource
    split : {"test", "validation"}
    count : int
        How many.
    frames : int
        Each must have so many.
    team : int
        The ego of each must have so many teammates.

    Raises
    ------
    SceneError
        If there are fewer, or one of them is too short or has a smaller team.
    """
    scenes = source.scenes(split)[:count]
    if len(scenes) < count:
        raise SceneError(f"{source.name} has {len(scenes)} {split} scenes; {count} are wanted")
    for scene in scenes:
        _check(source, scene, frames, team)
    return list(scenes)


def one_scene(source: SceneSource, split: Split, place: int, frames: int = 1, team: int = 1) -> Scene:
    """The scene at a place, counted from 0; ``frames`` and ``team`` as for `first_scenes`.

    Raises
    ------
    SceneError
        If there is none, or it is too short or has a smaller team.
    """
    scenes = source.scenes(split)
    if place >= len(scenes):
        raise SceneError(f"{source.name} has {len(scenes)} {split} scenes; that number {place}, from 0 on, is wanted")
    _check(source, scenes[place], frames, team)
    return scenes[place]


def _check(source: SceneSource, scene: Scene, frames: int, team: int) -> None:
    where = f"{source.name}, scene {scene.number}"
    if not scene.egos:
        raise SceneError(f"{where}: no agent may be the ego")
    if scene.length is not None and scene.length < frames:
        raise SceneError(f"{where} has {scene.length} frames; {frames} are wanted")
    if len(scene.agents) - 1 < team:
        raise SceneError(f"{where} has {len(scene.agents) - 1} teammates; {team} are wanted")


def whose_turn(scene: Scene, turn: int, *frames: Frame) -> str:
    """The ego whose turn it is, where vehicles take turns: the next one of those that are in all of some frames.

    Raises
    ------
    SceneError
        If none is.
    """
    present = [name for name in scene.egos if all(name in frame.views for frame in frames)]
    if not present:
        raise SceneError(f"scene {scene.number}, frame {frames[0].index}: nobody is there who may be the ego")
    return present[turn % len(present)]


def seconds_apart(scene: Scene, count: int) -> Iterator[Frame]:
    """``count`` frames of a scene that are 1 s apart, or all that there are."""
    step = max(1, round(1 / scene.frame_period_s))
    end = count * step if scene.length is None else min(count * step, scene.length)
    for index in range(0, end, step):
        yield scene.frame(index)
