"""The folder that sessions are recorded to: a file or more of each, and never more bytes than it may have."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from robosac import __version__
from robosac.files import make_folder
from robosac.interfaces.ros2 import Ros2
from robosac.recording.content import Moment, Opening
from robosac.recording.writing import RecordingFile
from service.keeping.record import SessionRecord

IDLE_S = 10.0
"""After so long without a frame a file is closed. The session's next frame begins another."""
LOOKS = 16
"""How often the folder is measured while as much is written as it may hold."""
KEY_LETTERS = 8
"""So much of the id of an API key is in the names of its recordings."""
REMEMBERED = 4096
"""Sessions of which it is known how many files they have."""
_NAME = re.compile(r"\d{8}T\d{6}Z-(?P<session>[0-9a-f]{32})-(?P<part>\d{4,})(-(?P<key>[0-9a-f]+))?\.mcap")


@dataclass
class _Open:
    """A file that is written to."""

    file: RecordingFile
    used: float
    part: int


@dataclass
class Folder:
    """Recordings on disk, used from one thread at a time.

    Parameters
    ----------
    root : Path
    most_file : int
        Bytes of a file after which the session's next one begins.
    most : int
        Bytes of all recordings in the folder, of other processes' too. The oldest are removed of the API key that has
        most.
    bodies : bool
        Whether messages are recorded, or their digests.
    most_open : int
        Files that the system has open at a time. The others wait for their sessions' next frames as they are.
    """

    root: Path
    most_file: int
    most: int
    bodies: bool
    most_open: int = 64
    _files: dict[str, _Open] = field(default_factory=dict)
    _at_hand: dict[str, None] = field(default_factory=dict)
    """Sessions whose files may be open, those used last at the end."""
    _ros2: Ros2 = field(default_factory=Ros2)
    _written: int | None = None
    """Bytes since the folder was measured, if it was."""
    _parts: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By session: the number of its latest file, and of frames answered by then."""

    def make(self) -> None:
        """Make the folder, and make sure that it can be written to.

        Raises
        ------
        OSError
        """
        make_folder(self.root)
        probe = self.root / ".probe"
        probe.touch()
        probe.unlink()

    def ask(self, session_id: str) -> None:
        """Keep that a session is to be recorded, for all processes that see the folder; from any thread.

        Raises
        ------
        OSError
        """
        self._asked(session_id).touch()

    def is_asked(self, record: SessionRecord) -> bool:
        """Whether a session is to be recorded, or is recorded already.

        Raises
        ------
        OSError
        """
        return self._asked(record.session_id).exists() or self._latest_part(record) > 0

    def over(self, session_id: str) -> None:
        """A session has ended: its recording is whole.

        Raises
        ------
        OSError
        """
        self._asked(session_id).unlink(missing_ok=True)
        self.end(session_id)
        self._parts.pop(session_id, None)

    def add(self, record: SessionRecord, moment: Moment, dropped: int) -> None:
        """Add a frame to its session's recording.

        Raises
        ------
        OSError
            If it cannot be written. What was written before stays readable, and the next frame begins a new file, as it
            does where somebody has removed the one before.
        """
        now, session_id = time.monotonic(), record.session_id
        opened = self._files.get(session_id)
        if opened is not None and opened.file.is_removed:
            self._files.pop(session_id).file.abandon()
            opened = None
        before = 0 if opened is None else opened.file.size
        opened = opened or self._begin(record, moment)
        self._use(session_id, opened, now)
        try:
            opened.file.add(moment, dropped)
        except BaseException:
            self._files.pop(session_id).file.abandon()
            raise
        self._remember(session_id, opened.part, record.frames_answered + 1)
        size = opened.file.size
        if size >= min(self.most_file, self.most // 2):
            self.end(session_id)
        self._written = (self._written or 0) + size - before
        if self._written * LOOKS >= self.most:
            self.make_room()

    def end(self, session_id: str) -> None:
        """Close a session's file, if one is open.

        Raises
        ------
        OSError
        """
        opened = self._files.pop(session_id, None)
        if opened is not None and opened.file.is_removed:
            opened.file.abandon()
        elif opened is not None:
            opened.file.close()

    def close(self, idle_s: float = 0.0) -> None:
        """Close the files that were not written to for so long.

        Raises
        ------
        OSError
            If one cannot be closed; the others are closed by the next call.
        """
        until = time.monotonic() - idle_s
        for session_id in [name for name, opened in self._files.items() if opened.used <= until]:
            self.end(session_id)

    def make_room(self) -> None:
        """Remove recordings while all together are too large: of the API key that has most the oldest, those that are
        being written last. So nobody's recordings go because another records much.
        """
        self._written = 0
        open_ones = {opened.file.path: name for name, opened in self._files.items()}
        of_keys: defaultdict[str, list[tuple[bool, float, int, Path]]] = defaultdict(list)
        for match, path in self._found():
            try:
                told = path.stat()
            except FileNotFoundError:  # another process was faster
                continue
            of_keys[match["key"] or ""].append((path in open_ones, told.st_mtime, told.st_size, path))
        totals = {key: sum(size for _, _, size, _ in files) for key, files in of_keys.items()}
        for files in of_keys.values():
            files.sort(reverse=True)
        while sum(totals.values()) > self.most:
            most = max(totals, key=lambda key: totals[key])
            is_open, _, size, path = of_keys[most].pop()
            if is_open:
                self._files.pop(open_ones[path]).file.abandon()
            path.unlink(missing_ok=True)
            totals[most] -= size

    def _begin(self, record: SessionRecord, moment: Moment) -> _Open:
        if self._written is None:
            self.make_room()
        part = self._latest_part(record) + 1
        began = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(moment.time_ns / 1e9))
        of_key = f"-{record.key_id[:KEY_LETTERS]}" if record.key_id else ""
        path = self.root / f"{began}-{record.session_id}-{part:04d}{of_key}.mcap"
        kept = {name: value for name, value in vars(record).items() if name in Opening.model_fields}
        more = {"version": __version__, "least_score": moment.least_score, "bodies": self.bodies, "part": part}
        opening = Opening(**kept, **more)
        return _Open(RecordingFile(path, opening, moment.time_ns, self._ros2), time.monotonic(), part)

    def _remember(self, session_id: str, part: int, frames: int) -> None:
        self._parts.pop(session_id, None)
        self._parts[session_id] = part, frames
        while len(self._parts) > REMEMBERED:
            del self._parts[next(iter(self._parts))]

    def _latest_part(self, record: SessionRecord) -> int:
        """The number of a session's latest file, 0 if it has none. The folder, which may hold very many, is read only
        where another process may have written files of the session.
        """
        part, frames = self._parts.get(record.session_id, (0, 0))
        if record.frames_answered == frames:
            return part
        return max((int(m["part"]) for m, _ in self._found() if m["session"] == record.session_id), default=0)

    def _use(self, session_id: str, opened: _Open, now: float) -> None:
        """A session's file is written to now; others that are open rest where they are too many."""
        opened.used = now
        self._files[session_id] = opened
        self._at_hand.pop(session_id, None)
        self._at_hand[session_id] = None
        while len(self._at_hand) > self.most_open:
            first = next(iter(self._at_hand))
            del self._at_hand[first]
            if first in self._files:
                self._files[first].file.rest()

    def _asked(self, session_id: str) -> Path:
        return self.root / f"{session_id}.asked"

    def _found(self) -> Iterator[tuple[re.Match[str], Path]]:
        for path in self.root.iterdir():
            if match := _NAME.fullmatch(path.name):
                yield match, path
