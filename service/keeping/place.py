"""Where the file of a database is."""

from __future__ import annotations

import stat
import threading
from collections.abc import Mapping
from pathlib import Path

JOURNAL = ("-wal", "-shm")
"""What SQLite has beside a file as long as somebody has it open: what was written last, and where in it that is."""


class Place:
    """Where a database's files are, if it has any. What is written to one that is not there any more is lost."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._file: Mapping[Path, tuple[int, int]] = {}
        self._journal: Mapping[Path, tuple[int, int]] = {}
        self._connections = 0
        self._counting = threading.Lock()

    def opened(self) -> None:
        """There is another connection to the file."""
        with self._counting:
            self._connections += 1

    def closed(self) -> None:
        """There is one less. With the last one SQLite removes the journal."""
        with self._counting:
            self._connections -= 1
            if not self._connections:
                self._journal = {}

    def remember(self) -> None:
        """The files are open."""
        if self._path is not None and not self._journal:
            real = self._path.resolve()  # beside which its journal is
            self._file = self._file or {self._path: _found(self._path)}
            journal = (real.with_name(real.name + end) for end in JOURNAL)
            self._journal = {path: _found(path) for path in journal if path.exists()}  # not on every file system

    def check(self) -> None:
        """Refuse to go on if a file that was opened is not in its place: others would not see what is written to it.

        Raises
        ------
        FileNotFoundError
        """
        for path, file in (*self._file.items(), *self._journal.items()):
            if file != _found(path):
                raise FileNotFoundError(f"{path.name} was moved, and another one put in its place")

    @property
    def lacks_its_journal(self) -> bool:
        """Whether some of what was beside the file was removed, and nothing was put or made in its place."""
        if not self._journal or any(not path.exists() or _found(path) != file for path, file in self._file.items()):
            return False
        there = {path: file for path, file in self._journal.items() if path.exists()}
        return len(there) < len(self._journal) and all(_found(path) == file for path, file in there.items())

    def of_everybody(self) -> Path | None:
        """The file, if everybody may read it or write to it; its group is for whoever runs the gateway to choose."""
        if self._path is None or not self._path.stat().st_mode & stat.S_IRWXO:
            return None
        return self._path


def _found(path: Path) -> tuple[int, int]:
    """Which file it is."""
    status = path.stat()
    return status.st_dev, status.st_ino
