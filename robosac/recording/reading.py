"""Reads recordings: whole ones, and such as end in the middle since the gateway was killed or its disk was full."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from pydantic import ValidationError

from robosac import wire
from robosac.answers import FrameAnswer
from robosac.boxes import FloatArray
from robosac.detectors import DetectorInfo, Message, TensorSpec
from robosac.extras import need
from robosac.recording.content import (
    ANSWERS,
    DIGESTS,
    FORMAT,
    FRAMES,
    MESSAGES,
    METADATA,
    POSES,
    SESSION,
    TRUTH,
    Decided,
    Digest,
    Opening,
    Poses,
    TrueFrame,
)
from robosac.recording.unpacking import records_in
from robosac.wire.fields import Fields, WireError, named, shown

if TYPE_CHECKING:
    from mcap.records import Message as Written

SUFFIX = ".mcap"
MOST_BYTES = 2**30
"""Of one chunk, or of one message, unpacked: a frame of 64 vehicles has a tenth of it."""
MAGIC_BYTES = 8
_DTYPES = frozenset(np.dtype(code).name for code in "bhilqBHILQefd")
"""Numbers that tensors may hold."""


class RecordingError(ValueError):
    """A file is no recording, or lacks what is asked of it."""


@dataclass(frozen=True)
class RecordedFrame:
    """A frame that was recorded."""

    file: RecordedFile = field(repr=False, compare=False)
    time_ns: int
    """When it was answered, Unix nanoseconds."""
    decided: Decided
    answer: FrameAnswer
    poses: Mapping[str, FloatArray]
    """By vehicle: world_from_sensor (4, 4)."""
    truth: TrueFrame | None
    chunks: tuple[int, ...]
    """Where in the file it is."""

    @property
    def number(self) -> int:
        """The one that the vehicles gave it."""
        return self.decided.frame

    @property
    def true_boxes(self) -> FloatArray | None:
        """(G, 5): x, y, length, width, yaw; ego frame. None where they were not recorded."""
        return None if self.truth is None else np.array(self.truth.boxes, dtype=np.float64).reshape(-1, 5)

    def messages(self) -> dict[str, Message]:
        """By vehicle: all messages of the frame, those that did not take part, too.

        Raises
        ------
        RecordingError
            If only their digests were recorded, or the file cannot be read any more.
        """
        if not self.file.opening.bodies:
            raise RecordingError(f"{self.file.path} holds digests in the place of messages")
        return dict(self.file.messages(self))


@dataclass
class RecordedFile:
    """A file, of which everything but messages is in memory."""

    path: Path
    opening: Opening
    frames: list[RecordedFrame] = field(default_factory=list)
    damage: str | None = None
    """How the file ends, if it is not whole; the frames before that are good."""
    counts: dict[str, int] = field(default_factory=dict)
    """By topic: what is on it."""
    topics: dict[int, str] = field(default_factory=dict)
    """By number of the channel."""

    def messages(self, frame: RecordedFrame) -> Iterator[tuple[str, Message]]:
        """See `RecordedFrame.messages`."""
        from mcap.records import Chunk  # noqa: PLC0415 (of an extra)
        from mcap.records import Message as Written  # noqa: PLC0415
        from mcap.stream_reader import StreamReader  # noqa: PLC0415

        with self.path.open("rb") as file:
            for place in frame.chunks:
                file.seek(place)
                record = next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
                if not isinstance(record, Chunk):
                    raise RecordingError(f"{self.path} was changed while it was read")
                for told in records_in(record):
                    if isinstance(told, Written) and self._is_of(told, frame):
                        yield _message(told.data, self.path)

    def _is_of(self, told: Written, frame: RecordedFrame) -> bool:
        return self.topics.get(told.channel_id) == MESSAGES and told.log_time == frame.time_ns


@dataclass(frozen=True)
class RecordedSession:
    """A session, whose files may be several."""

    opening: Opening
    """Of the first file that is there."""
    frames: Sequence[RecordedFrame]
    """By their numbers, whichever file they are in."""
    files: Sequence[RecordedFile]

    @property
    def without_truth(self) -> int:
        """Frames whose truth was not recorded."""
        return sum(frame.truth is None for frame in self.frames)


def sessions(path: Path) -> list[RecordedSession]:
    """The sessions in a file, or in a folder, the one that was recorded first in front.

    Of a folder, files without a recorded frame are passed over, such as those of others.

    Raises
    ------
    RecordingError
        If there is none, or two files differ in a frame that both hold.
    OSError
        If a file cannot be read.
    """
    files = _of_folder(path) if path.is_dir() else [read(path)]
    if not files:
        raise RecordingError(f"{path} holds no recording ({SUFFIX})")
    parts: dict[str, list[RecordedFile]] = {}
    for file in sorted(files, key=lambda file: file.frames[0].time_ns if file.frames else 0):
        parts.setdefault(file.opening.session_id, []).append(file)
    return [RecordedSession(group[0].opening, _in_order(group), group) for group in parts.values()]


def _in_order(files: Sequence[RecordedFile]) -> list[RecordedFrame]:
    """Frames of a session by their numbers: several processes may have answered them by turns. Of a file there may be a
    copy in the folder.
    """
    found: dict[int, RecordedFrame] = {}
    for frame in (frame for file in files for frame in file.frames):
        other = found.setdefault(frame.number, frame)
        if other is not frame and _shown(other) != _shown(frame):
            both = " and ".join(dict.fromkeys(str(each.file.path) for each in (other, frame)))
            raise RecordingError(f"frame {frame.number} is recorded twice, and not as the same, in {both}")
    return [found[number] for number in sorted(found)]


def _shown(frame: RecordedFrame) -> tuple[int, str, str]:
    return frame.time_ns, frame.decided.model_dump_json(), frame.answer.model_dump_json()


def _of_folder(folder: Path) -> list[RecordedFile]:
    files = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        if not path.is_file():  # nobody may ever write to a pipe
            continue
        with suppress(RecordingError):
            files.append(read(path))
    return [file for file in files if file.frames]


def read(path: Path) -> RecordedFile:
    """Read a file as far as it is good.

    Raises
    ------
    RecordingError
        If it is no recording of this version, or has no session.
    OSError
        If it cannot be read.
    """
    need("mcap", "recordings")
    found: RecordedFile | None = None
    parts: dict[str, Any] = {}
    places: list[int] = []
    counts: dict[str, int] = {}
    scan = _Scan(path)
    for place, topic, told in scan.messages():
        counts[topic] = counts.get(topic, 0) + 1
        try:
            if topic == SESSION:
                opening = Opening.model_validate_json(told.data)
                found = found or RecordedFile(path, opening, counts=counts, topics=scan.topics)
                continue
            if place not in places:
                places.append(place)
            if topic in _READ:
                parts[topic] = _READ[topic].model_validate_json(told.data)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise RecordingError(f"{path}: what is on {topic} is not of this form: {where}: {first['msg']}") from error
        if topic == FRAMES and found is not None:
            if {ANSWERS, POSES} <= parts.keys() and found.opening.ego_id in parts[POSES].poses:
                what = (parts[FRAMES], parts[ANSWERS], parts[POSES].poses, parts.get(TRUTH))
                found.frames.append(RecordedFrame(found, told.log_time, *what, tuple(places)))
            parts, places = {}, []
    if found is None:
        raise RecordingError(f"{path} is no recording of a session" + (f": {scan.damage}" if scan.damage else ""))
    found.damage = scan.damage
    return found


_READ: Mapping[str, Any] = {ANSWERS: FrameAnswer, FRAMES: Decided, POSES: Poses, TRUTH: TrueFrame, DIGESTS: Digest}


class _Scan:
    """One pass over a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damage: str | None = None
        self.topics: dict[int, str] = {}

    def messages(self) -> Iterator[tuple[int, str, Written]]:
        """Place of the chunk, topic, and record of each message, as far as the file is good."""
        from mcap.exceptions import InvalidMagic  # noqa: PLC0415 (of an extra)

        with self._path.open("rb") as file:
            try:
                yield from self._records(file)
            except (OSError, RecordingError):
                raise
            except InvalidMagic as error:
                if file.tell() <= MAGIC_BYTES:
                    raise RecordingError(f"{self._path} is no MCAP file") from error
                self.damage = "its last bytes are missing"
            except Exception as error:  # what is cut off or garbled fails in the reader, or in what decompresses
                self.damage = f"it ends in the middle ({type(error).__name__})"

    def _records(self, file: BinaryIO) -> Iterator[tuple[int, str, Written]]:
        from mcap.records import Channel, Chunk, Metadata  # noqa: PLC0415 (of an extra)
        from mcap.records import Message as Written  # noqa: PLC0415
        from mcap.stream_reader import StreamReader  # noqa: PLC0415

        place = 0
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST_BYTES).records:
            if isinstance(record, Metadata) and record.name == METADATA and record.metadata.get("format") != FORMAT:
                found = record.metadata.get("format")
                raise RecordingError(f"{self._path} has the format {found!r}; this version reads {FORMAT!r}")
            if isinstance(record, Chunk):
                if record.uncompressed_size > MOST_BYTES:
                    raise RecordingError(f"{self._path} has a chunk of {record.uncompressed_size} bytes")
                for told in records_in(record):
                    if isinstance(told, Channel):
                        self.topics[told.id] = told.topic
                    elif isinstance(told, Written):
                        yield place, self.topics[told.channel_id], told
            place = file.tell()


def _message(body: bytes, path: Path) -> tuple[str, Message]:
    """A vehicle's message, of whatever detector."""
    try:
        envelope = wire.read_message(body)
        tensors = envelope.payload.get("tensors")
        sent = tensors if isinstance(tensors, dict) else {}
        specs = {name: _spec(Fields(sent[name], f"tensors.{name}")) for name in named(sent, "tensors")}
        if sum(_bytes(spec) for spec in specs.values()) > MOST_BYTES:
            raise WireError("out-of-range", "tensors", f"must be no more than {MOST_BYTES} bytes")
        layout = DetectorInfo("as recorded", {"ego": specs}, (0, 0, 0, 0), 1.0, "", 0.0)
        return envelope.vehicle_id, wire.check_message(envelope.payload, layout, "ego")
    except (ValueError, OverflowError) as error:  # of what is sent, or of an array of a shape that cannot be
        raise RecordingError(f"{path}: a message cannot be read: {error}") from error


def _spec(sent: Fields) -> TensorSpec:
    """What a tensor says that it is."""
    dtype, shape = sent.take("dtype", str), sent.take("shape", list)
    if dtype not in _DTYPES:
        raise WireError("wrong-dtype", sent.at("dtype"), f"tensors hold numbers, got {shown(dtype)}")
    if not all(type(size) is int and size >= 0 for size in shape):
        raise WireError("wrong-shape", sent.at("shape"), "must be an array of integers that are not negative")
    return TensorSpec(dtype, tuple(shape))


def _bytes(spec: TensorSpec) -> int:
    return math.prod(spec.shape) * np.dtype(spec.dtype).itemsize
