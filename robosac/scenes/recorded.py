"""Recordings of the gateway as scenes: what the vehicles really sent, and what is true where that was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from robosac.boxes import FloatArray
from robosac.extras import MissingExtra
from robosac.faults import told
from robosac.recording.reading import RecordedFrame, RecordedSession, RecordingError, sessions
from robosac.scenes.base import SceneError, Split, View

_NO_RETURNS = np.zeros((0, 3))


@dataclass(frozen=True)
class RecordedInstant:
    """A frame of a recording. Its views hold messages in the place of LiDAR returns."""

    index: int
    """Its place in the recording; the vehicles may have numbered it otherwise."""
    recorded: RecordedFrame
    ego_id: str

    @cached_property
    def views(self) -> Mapping[str, View]:
        """By vehicle: its pose, and the message that it sent."""
        try:
            messages = self.recorded.messages()
        except (RecordingError, OSError) as error:
            raise SceneError(str(error)) from error
        return {name: View(message.pose, _NO_RETURNS, message=message) for name, message in messages.items()}

    @property
    def attackers(self) -> tuple[str, ...]:
        """Vehicles of whom was recorded that their messages are attacks."""
        return () if self.recorded.truth is None else self.recorded.truth.attackers

    def truth(self, ego: str) -> FloatArray:
        """True boxes (G, 5), in the frame of the ego of the session.

        Raises
        ------
        SceneError
            If they were not recorded, or somebody else is to be the ego.
        """
        where = f"{self.recorded.file.path}, frame {self.recorded.number}"
        if ego != self.ego_id:
            raise SceneError(f"{where}: true boxes are known for {self.ego_id} only, not for {ego}")
        boxes = self.recorded.true_boxes
        if boxes is None:
            raise SceneError(f"{where}: no truth was recorded, and without it nothing can be measured")
        return boxes


@dataclass(frozen=True)
class RecordedScene:
    """A recorded session."""

    number: int
    session: RecordedSession

    @property
    def agents(self) -> Sequence[str]:
        """The ego, then all who were ever its teammates."""
        team = dict.fromkeys(name for frame in self.session.frames for name in frame.decided.team)
        return [self.session.opening.ego_id, *(team or self.session.opening.teammates)]

    @property
    def egos(self) -> Sequence[str]:
        """The one of the session."""
        return [self.session.opening.ego_id]

    @property
    def length(self) -> int:
        """Recorded frames."""
        return len(self.session.frames)

    @property
    def frame_period_s(self) -> float:
        """As the session was opened with."""
        return self.session.opening.frame_period_ms / 1e3

    def frame(self, index: int) -> RecordedInstant:
        """The frame of a place in the recording."""
        return RecordedInstant(index, self.session.frames[index], self.session.opening.ego_id)


class Recording:
    """All sessions in a file, or in the files of a folder; each is a scene, whatever it is to serve.

    Parameters
    ----------
    path : Path or str

    Raises
    ------
    SceneError
        If there is no recording, or one cannot be read.
    """

    kind = "recording"

    def __init__(self, path: Path | str = "") -> None:
        if not str(path):
            raise SceneError("recording:FILE, or a folder of such files")
        self.path = Path(path)
        try:
            self._sessions = sessions(self.path)
        except (RecordingError, MissingExtra, OSError) as error:
            raise SceneError(told(error)) from error

    @property
    def name(self) -> str:
        """Its path, and what is in it."""
        ids = "+".join(f"{session.opening.session_id[:8]}:{len(session.frames)}" for session in self._sessions)
        return f"{self.kind}:{self.path}#{ids}" if len(ids) < 200 else f"{self.kind}:{self.path}"

    def scenes(self, split: Split) -> Sequence[RecordedScene]:  # noqa: ARG002 (whoever records decides what it serves)
        """All sessions."""
        return [RecordedScene(number, session) for number, session in enumerate(self._sessions)]
