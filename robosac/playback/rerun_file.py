"""Recordings as files of the viewer rerun (``.rrd``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robosac.answers import Standing
from robosac.boxes import FloatArray, to_world
from robosac.extras import need
from robosac.files import replacing
from robosac.interfaces.ros2 import HEIGHT_M, quaternions
from robosac.recording.reading import RecordedFrame, RecordedSession
from robosac.scenes.drawing import FOUND_COLOUR, STANDING_COLOURS, TRUE_COLOUR

if TYPE_CHECKING:
    from rerun import RecordingStream

APPLICATION = "robosac"
FAR_M = 10_000.0
"""The viewer keeps places in single precision: half a metre is its step at 5 000 km, 1 mm here."""
_ACCEPTED, _REJECTED = FOUND_COLOUR, STANDING_COLOURS[Standing.CONTRADICTED]


def write_rerun(session: RecordedSession, path: Path) -> None:
    """Write a session's poses, boxes, truth and suspicion; all boxes are in the world's frame.

    Where the ego begins farther than `FAR_M` from the world's origin along an axis, whole kilometres are taken off; the
    text ``origin`` says how many.

    Parameters
    ----------
    session : RecordedSession
    path : Path
        The ``.rrd``.

    Raises
    ------
    MissingExtra
        If rerun is not installed.
    """
    need("rerun", "files of rerun")
    import rerun as rr  # noqa: PLC0415 (of an extra)

    with replacing(path) as beside, beside.open("wb") as file:  # rerun itself hangs where a disk is full
        stream = rr.RecordingStream(APPLICATION, recording_id=session.opening.session_id)
        written = stream.memory_recording()
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        origin = _origin(session)
        if origin.any():
            text = "All places are metres from ({:.0f}, {:.0f}, {:.0f}) of the world.".format(*origin)
            stream.log("origin", rr.TextDocument(text), static=True)
        for frame in session.frames:
            stream.set_time("time", timestamp=np.datetime64(frame.time_ns, "ns"))
            stream.set_time("frame", sequence=frame.number)
            _log(stream, rr, frame, session.opening.ego_id, origin)
        file.write(written.drain_as_bytes())


def _origin(session: RecordedSession) -> FloatArray:
    """What is taken off all places (3,), metres."""
    if not session.frames:
        return np.zeros(3)
    first: FloatArray = session.frames[0].poses[session.opening.ego_id][:3, 3]
    return np.where(np.abs(first) > FAR_M, np.round(first / 1e3) * 1e3, 0.0)


def _log(stream: RecordingStream, rr: Any, frame: RecordedFrame, ego_id: str, origin: FloatArray) -> None:
    answer, pose = frame.answer, frame.poses[ego_id].copy()
    pose[:3, 3] -= origin
    for name, turn in zip(frame.poses, quaternions(list(frame.poses.values())), strict=True):
        place = frame.poses[name][:3, 3] - origin
        stream.log(f"world/vehicles/{name}", rr.Transform3D(translation=place, quaternion=turn))
        colour = _ACCEPTED if name == ego_id or name in answer.accepted else _REJECTED
        shape = rr.Boxes3D(half_sizes=[[0.4, 0.4, 0.4]], colors=[_rgb(colour)], labels=[name])
        stream.log(f"world/vehicles/{name}/sensor", shape)
    support = answer.support or [None] * len(answer.boxes)
    colours = [FOUND_COLOUR if each is None else STANDING_COLOURS[each.status] for each in support]
    stream.log("world/boxes", _boxes(rr, answer.boxes, pose, colours))
    out = np.array([each.box for each in answer.contradicted or ()]).reshape(-1, 6)
    stream.log("world/contradicted", _boxes(rr, out, pose, [_REJECTED] * len(out)))
    if (true := frame.true_boxes) is not None:
        stream.log("world/truth", _boxes(rr, true, pose, [TRUE_COLOUR] * len(true)))
    for name, suspicion in (answer.suspicion or {}).items():
        stream.log(f"suspicion/{name}", rr.Scalars(suspicion))
    left_out = ", ".join(f"{name}: {entry.reason.value}" for name, entry in answer.rejected.items())
    stream.log("decision", rr.TextLog(f"{answer.source.value} of {', '.join(answer.accepted) or 'nobody'}; {left_out}"))


def _boxes(rr: Any, boxes: FloatArray, pose: FloatArray, colours: Sequence[str]) -> Any:
    placed = to_world(boxes, pose)
    x, y, length, width, yaw = placed[:, :5].T
    level, high = np.full(len(boxes), pose[2, 3]), np.full(len(boxes), HEIGHT_M / 2)
    nothing = np.zeros(len(boxes))
    return rr.Boxes3D(
        centers=np.column_stack([x, y, level]),
        half_sizes=np.column_stack([length / 2, width / 2, high]),
        quaternions=np.column_stack([nothing, nothing, np.sin(yaw / 2), np.cos(yaw / 2)]),
        colors=[_rgb(colour) for colour in colours],
    )


def _rgb(colour: str) -> list[int]:
    return list(bytes.fromhex(colour.removeprefix("#")))
