"""What a source of scenes is to the rest of the project.

A source has scenes, a scene has frames, and a frame has what each agent senses and the true boxes. Whatever gives these
can be calibrated on, compared on, and driven through a gateway: the synthetic intersection, recorded data, or the
user's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from robosac.boxes import FloatArray

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


@runtime_checkable
class SceneSource(Protocol):
    """Where scenes come from. It is sent to other processes where several share the work, so it has to be picklable."""

    @property
    def name(self) -> str:
        """Says which data this is; recordings and calibrations are kept under it."""

    def scenes(self, split: Split) -> Sequence[Scene]:
        """The scenes for a purpose, always in the same order. No frame is made before it is asked for."""


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
        where = f"{source.name}, scene {scene.number}"
        if not scene.egos:
            raise SceneError(f"{where}: no agent may be the ego")
        if scene.length is not None and scene.length < frames:
            raise SceneError(f"{where} has {scene.length} frames; {frames} are wanted")
        if len(scene.agents) - 1 < team:
            raise SceneError(f"{where} has {len(scene.agents) - 1} teammates; {team} are wanted")
    return list(scenes)


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
