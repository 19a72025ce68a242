"""Writes recordings. After each frame the file can be read up to it, whatever comes after."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO, cast

from robosac import wire
from robosac.answers import Typed
from robosac.extras import need
from robosac.interfaces.ros2 import TOPICS, Ros2, SeenFrame
from robosac.previous import PreviousAnswer
from robosac.recording.content import (
    ANSWERS,
    DIGESTS,
    FORMAT,
    FORMS,
    FRAMES,
    MESSAGES,
    METADATA,
    POSES,
    SESSION,
    TRUTH,
    Before,
    Decided,
    Digest,
    Moment,
    Opening,
    Poses,
    TrueFrame,
)


class _Growing:
    """A new file that is only added to, and is open only as long as it is of use."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO = path.open("xb")
        self._size = 0

    @property
    def is_removed(self) -> bool:
        return not self._path.exists() if self._file.closed else os.fstat(self._file.fileno()).st_nlink == 0

    def rest(self) -> None:
        self._size = self.tell()
        self._file.close()

    def write(self, data: bytes) -> int:
        return self._open().write(data)

    def flush(self) -> None:
        self._open().flush()

    def tell(self) -> int:
        return self._size if self._file.closed else self._file.tell()

    def fileno(self) -> int:
        return self._open().fileno()

    def close(self) -> None:
        self._file.close()

    def _open(self) -> BinaryIO:
        if self._file.closed:
            self._file = self._path.open("r+b")  # not "ab", which would make a file anew that is removed
            self._file.seek(0, os.SEEK_END)
        return self._file


class RecordingFile:
    """A new file of a session, which frames are added to.

    Parameters
    ----------
    path : Path
        There must be nothing yet.
    opening : Opening
    time_ns : int
        Now, Unix nanoseconds.
    ros2 : Ros2, optional
        Makes the messages for viewers; by default one of its own.

    Raises
    ------
    MissingExtra
        If MCAP cannot be written.
    OSError
        If the file cannot be made or written; this goes for `add` and `close`, too.
    """

    def __init__(self, path: Path, opening: Opening, time_ns: int, ros2: Ros2 | None = None) -> None:
        need("mcap", "recordings")
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415 (of an extra)

        self.path = path
        self._opening = opening
        self._ros2 = ros2 or Ros2()
        self._left: object = None
        self._left_previous: PreviousAnswer | None = None
        self._begun = False
        self._channels: dict[str, int] = {}
        self._file = _Growing(path)
        try:
            self._writer = Writer(cast("BinaryIO", self._file), compression=CompressionType.LZ4)
            self._writer.start(profile="", library="robosac")
            self._writer.add_metadata(METADATA, {"format": FORMAT, "session": opening.session_id})
            for topic in FORMS:
                self._register(topic)
            for topic in TOPICS:
                self._register_ros2(topic)
            self._put(SESSION, opening, time_ns)
            self._writer.flush()  # type: ignore[no-untyped-call]
        except BaseException:
            self.abandon()
            path.unlink()  # nothing is in it
            raise

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    @property
    def is_removed(self) -> bool:
        """Whether somebody has removed the file, so that nothing can be read any more of what is written to it."""
        return self._file.is_removed

    def rest(self) -> None:
        """Have no file open until more is added: of those a process may have only so many."""
        self._file.rest()

    def add(self, moment: Moment, dropped: int = 0) -> None:
        """Add a frame, after so many that were not added."""
        answer, now = moment.answer, moment.time_ns
        for name, said in moment.messages.items():
            if self._opening.bodies:
                body = wire.pack_message(answer.frame, name, said.message, said.signature)
                self._add(MESSAGES, body, now, int(said.at * 1e9))
            else:
                signature = None if said.signature is None else said.signature.hex()
                digest = Digest(frame=answer.frame, vehicle_id=name, digest=said.digest, signature=signature)
                self._put(DIGESTS, digest, now, int(said.at * 1e9))
        poses = {name: said.message.pose for name, said in moment.messages.items()}
        self._put(POSES, Poses(frame=answer.frame, poses=poses), now)
        truth = moment.truth
        if truth is not None:
            told = TrueFrame(frame=answer.frame, boxes=truth.boxes.tolist(), attackers=truth.attackers)
            self._put(TRUTH, told, now)
        true = None if truth is None else truth.boxes
        seen = SeenFrame(now, self._opening.ego_id, poses, answer, true, self._opening.least_score)
        for topic, data in self._ros2.messages(seen).items():
            self._add(topic, data, now, now)
        self._put(ANSWERS, answer, now)
        self._put(FRAMES, self._decided(moment, dropped), now)
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index, with which the file is whole."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Leave the file as it is: it cannot be written to any more."""
        try:
            self._file.close()
        except OSError:  # what was not written yet is lost
            return

    def _decided(self, moment: Moment, dropped: int) -> Decided:
        goes_on = self._begun and self._left == moment.state and _same(self._left_previous, moment.previous)
        self._begun, self._left, self._left_previous = True, moment.left, moment.left_previous
        previous = None if moment.previous is None else moment.previous.as_json()
        return Decided(
            frame=moment.answer.frame,
            team=moment.team,
            fused=moment.fused,
            seed=moment.seed,
            before=None if goes_on else Before(state=dict(moment.state), previous=previous),
            out_of_time=moment.out_of_time,
            dropped=dropped,
        )

    def _register(self, topic: str) -> None:
        form = FORMS[topic]
        schema = self._writer.register_schema(form.name, "jsonschema", form.schema.encode())
        self._channels[topic] = self._writer.register_channel(topic, form.encoding, schema)

    def _register_ros2(self, topic: str) -> None:
        name = TOPICS[topic]
        schema = self._writer.register_schema(name, "ros2msg", self._ros2.schema(name).encode())
        self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)

    def _put(self, topic: str, told: Typed, now: int, sent: int | None = None) -> None:
        self._add(topic, told.model_dump_json().encode(), now, now if sent is None else sent)

    def _add(self, topic: str, data: bytes, now: int, sent: int) -> None:
        self._writer.add_message(self._channels[topic], log_time=now, data=data, publish_time=sent)


def _same(left: PreviousAnswer | None, previous: PreviousAnswer | None) -> bool:
    return (left is None) == (previous is None) and (left is None or previous is None or left.frame == previous.frame)
