"""Where the file of a database is."""

from __future__ import annotations

import stat
from pathlib import Path


class Place:
    """Where a database's file is, if it has one. What is written to one that is not there any more is lost."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._file: tuple[int, int] | None = None

    def remember(self) -> None:
        """The file is open."""
        if self._file is None and self._path is not None:
            self._file = self._found(self._path)

    def check(self) -> None:
        """Refuse to go on if the file that was opened is not in its place.

        Raises
        ------
        FileNotFoundError
        """
        if self._file is not None and self._path is not None and self._file != self._found(self._path):
            raise FileNotFoundError("the database's file was moved, and another one put in its place")

    def of_everybody(self) -> Path | None:
        """The file, if everybody may read it or write to it; its group is for whoever runs the gateway to choose."""
        if self._path is None or not self._path.stat().st_mode & stat.S_IRWXO:
            return None
        return self._path

    def _found(self, path: Path) -> tuple[int, int]:
        status = path.stat()
        return status.st_dev, status.st_ino
