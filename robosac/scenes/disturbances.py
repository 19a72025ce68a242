"""What goes wrong between the world and the ego, put around any scene.

Each class here takes a scene and is one: the same agents, the same truth, but somebody senses worse, is late, or is
wrong about its pose. They can be put around each other, and around scenes of one's own data. A *teammate* is any agent
but the first ego, the one that sequences belong to; only `JumpingEgo` and `NarrowEgo` touch that. True boxes stay those
of the scene itself: what rain hides is there all the same. In a recording, whose views hold messages in the place of
returns, what changes returns changes nothing.

What is random follows from the scene's number, the frame's, and the agent, so any frame can be had by itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robosac.boxes import FloatArray, pose_matrix
from robosac.scenes.base import Frame, SceneAround, View

_STREAM = 7_000_000
"""Frames of generated scenes draw from streams that begin with the scene's and the frame's number."""
_DROPPED, _LATE, _RAIN, _NOISE, _NOISY, _BIAS, _JUMP, _COVERED, _COVER = range(_STREAM, _STREAM + 9)


@dataclass(frozen=True)
class DisturbedFrame:
    """A frame of which some agents have other views."""

    original: Frame
    views: Mapping[str, View]

    @property
    def index(self) -> int:
        """That of the original."""
        return self.original.index

    @property
    def attackers(self) -> Sequence[str]:
        """Agents whose messages are attacks already, as the original names them."""
        named: Sequence[str] = getattr(self.original, "attackers", ())
        return named

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5) of the original, in the frame of the sensor as it really stands."""
        return self.original.truth(ego)


@dataclass(frozen=True)
class Disturbed(SceneAround, ABC):
    """A scene of which a subclass changes the views."""

    @property
    def teammates(self) -> tuple[str, ...]:
        """All agents but the first ego, in their order."""
        return tuple(name for name in self.scene.agents if name != self.scene.egos[0])

    def frame(self, index: int) -> Frame:
        """The frame of the scene, disturbed."""
        original = self.scene.frame(index)
        return DisturbedFrame(original, self.views(original))

    @abstractmethod
    def views(self, frame: Frame) -> Mapping[str, View]:
        """What stands in the place of a frame's views; an agent that is left out is absent."""

    def rng(self, stream: int, *more: int) -> np.random.Generator:
        """For draws that are the same whenever the same is asked for."""
        return np.random.default_rng([self.number, stream, *more])

    def one_of_them(self, stream: int) -> tuple[str, ...]:
        """A teammate drawn for the whole scene; empty if there is none."""
        team = self.teammates
        return (team[self.rng(stream).integers(len(team))],) if team else ()


@dataclass(frozen=True)
class Rain(Disturbed):
    """Returns are missing with every agent, the more the farther away."""

    missing: float = 0.3
    """Share of the returns that is lost at any distance, from 0 to 1."""
    reach_m: float = 60.0
    """Of the others, ``exp(-distance / reach_m)`` are left."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        disturbed = dict(frame.views)
        numbers = {name: number for number, name in enumerate(self.agents)}
        for name, view in scans(frame, self.agents):
            kept = (1.0 - self.missing) * np.exp(-np.linalg.norm(view.points, axis=1) / self.reach_m)
            drawn = self.rng(_RAIN, frame.index, numbers[name]).random(len(kept))
            disturbed[name] = View(view.pose, view.points[drawn < kept])
        return disturbed


@dataclass(frozen=True)
class NoisyScanner(Disturbed):
    """One teammate's ranges are wrong, each return's by itself."""

    noise_m: float = 0.4
    """Standard deviation, metres."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        disturbed = dict(frame.views)
        for name, view in scans(frame, self.one_of_them(_NOISY)):
            distance = np.maximum(np.linalg.norm(view.points, axis=1), 0.1)
            wrong = self.rng(_NOISE, frame.index).normal(0.0, self.noise_m, len(distance))
            stretch = np.maximum(1.0 + wrong / distance, 0.0).astype(view.points.dtype)
            disturbed[name] = View(view.pose, view.points * stretch[:, None])
        return disturbed


@dataclass(frozen=True)
class Late(Disturbed):
    """Teammates send what they sensed some frames ago.

    Who has no such frame, as at the beginning of the scene, sends what it senses now.
    """

    everybody: bool = False
    """All teammates are late, or one that is drawn for the scene."""
    fresh_pose: bool = True
    """Whether the old returns come with the pose of now. With the old pose what stands still is where it was seen; with
    that of now it moves along with a sender that moves.
    """
    frames: int = 1
    """How late."""
    every: int = 1
    """Only one frame in so many is sensed anew; what it holds is sent again in those after it."""
    slower_every: int = 0
    """After so many frames it is one frame later than before, as a clock that goes slower; 0: never."""
    _last: dict[int, Frame] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The frames that the next one will ask for again."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        late = self.teammates if self.everybody else self.one_of_them(_LATE)
        disturbed = dict(frame.views)
        if 0 <= self._sensed(frame.index) < frame.index:
            earlier = self._earlier(self._sensed(frame.index)).views
            for name in late:
                if name in disturbed and name in earlier:
                    old = earlier[name]
                    disturbed[name] = replace(old, pose=disturbed[name].pose) if self.fresh_pose else old
        self._keep(frame)
        return disturbed

    def _sensed(self, index: int) -> int:
        """The frame that is sent in the one of this index, if there is such a frame."""
        lag = self.frames + (index // self.slower_every if self.slower_every else 0)
        return index - index % self.every - lag

    def _earlier(self, index: int) -> Frame:
        kept = self._last.get(index)
        return self.scene.frame(index) if kept is None else kept

    def _keep(self, frame: Frame) -> None:
        self._last[frame.index] = frame
        needed = range(self._sensed(frame.index + 1), frame.index + 1)
        for index in [index for index in self._last if index not in needed]:
            del self._last[index]


@dataclass(frozen=True)
class Covered(Disturbed):
    """One teammate's scanner is covered for a while: all its returns come from the cover."""

    first: int = 5
    """The frame in which it is covered."""
    frames: int = 10
    """For how long."""
    off_m: float = 1.0
    """How far the cover is from the scanner, metres; each return by itself is wrong by 3 cm, standard deviation."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        disturbed = dict(frame.views)
        if self.first <= frame.index < self.first + self.frames:
            for name, view in scans(frame, self.one_of_them(_COVERED)):
                off = self.off_m + self.rng(_COVER, frame.index).normal(0.0, 0.03, len(view.points))
                away = np.maximum(np.linalg.norm(view.points, axis=1), 0.1)
                disturbed[name] = View(view.pose, view.points * (off / away)[:, None].astype(view.points.dtype))
        return disturbed


@dataclass(frozen=True)
class Dropped(Disturbed):
    """Messages get lost: a teammate is absent from a frame now and then."""

    share: float = 0.1
    """Of all messages."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        lost = self.rng(_DROPPED, frame.index).random(len(self.agents)) < self.share
        gone = {name for name, is_lost in zip(self.agents, lost, strict=True) if is_lost} - {self.egos[0]}
        return {name: view for name, view in frame.views.items() if name not in gone}


@dataclass(frozen=True)
class Biased(Disturbed):
    """Each teammate is wrong about its position by the same vector all the time."""

    bias_m: float = 0.2
    """Along the world's x and y, each time with a sign that is drawn for the scene; metres."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        signs = self.rng(_BIAS).choice([-1.0, 1.0], (len(self.agents), 2))
        wrong = dict(zip(self.agents, self.bias_m * signs, strict=True))
        wrong[self.egos[0]] = np.zeros(2)
        return {name: replaced(view, *wrong[name]) for name, view in frame.views.items()}


@dataclass(frozen=True)
class JumpingEgo(Disturbed):
    """The first ego is wrong about its own pose, in each frame anew."""

    error_m: float = 0.1
    error_deg: float = 0.2
    """Standard deviations along the world's x and y, and of the heading."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        rng = self.rng(_JUMP, frame.index)
        dx, dy = rng.normal(0.0, self.error_m, 2)
        turn = rng.normal(0.0, np.deg2rad(self.error_deg))
        ego = self.egos[0]
        return {name: replaced(view, dx, dy, turn) if name == ego else view for name, view in frame.views.items()}


@dataclass(frozen=True)
class NarrowEgo(Disturbed):
    """The first ego sees only what is ahead of it."""

    view_deg: float = 120.0
    """How wide."""

    def views(self, frame: Frame) -> Mapping[str, View]:
        disturbed = dict(frame.views)
        for name, view in scans(frame, self.egos[:1]):
            seen = np.abs(np.arctan2(view.points[:, 1], view.points[:, 0])) <= np.deg2rad(self.view_deg / 2)
            disturbed[name] = View(view.pose, view.points[seen])
        return disturbed


def scans(frame: Frame, names: Iterable[str]) -> Iterator[tuple[str, View]]:
    """The views of those who are present with what they sense. A view with a message holds what was sent instead."""
    for name in names:
        view = frame.views.get(name)
        if view is not None and getattr(view, "message", None) is None:
            yield name, view


def replaced(view: View, dx: float, dy: float, turn: float = 0.0) -> View:
    """A view of an agent that believes to stand (dx, dy) metres away, and turned by an angle in radians."""
    pose = view.pose.copy()
    pose[:3, :3] = pose_matrix(0.0, 0.0, 0.0, turn)[:3, :3] @ view.pose[:3, :3]
    pose[:2, 3] += dx, dy
    return replace(view, pose=pose)
