"""What an operator does to a gateway's SQLite file from another process, as documented for a running gateway."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path


def path_of(database_url: str) -> Path | None:
    """The file of a database URL; None if it is not SQLite."""
    scheme, _, path = database_url.partition(":///")
    return Path(path.partition("?")[0]) if scheme == "sqlite" else None


def integrity(path: Path) -> list[str]:
    """What is wrong with a file."""
    try:
        with closing(sqlite3.connect(path)) as database:
            found = [str(row[0]) for row in database.execute("PRAGMA integrity_check")]
    except sqlite3.Error as error:
        found = [str(error)]
    return [] if found == ["ok"] else [f"{path.name}: {complaint}" for complaint in found]


def read_and_back_up(path: Path, copy: Path) -> list[str]:
    """Read a file, back it up, and say what is wrong with the backup."""
    copy.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(path)) as database:
            database.execute("SELECT COUNT(*) FROM audit_lines").fetchone()
        with closing(sqlite3.connect(path)) as database, closing(sqlite3.connect(copy)) as backup:
            database.backup(backup)
    except sqlite3.Error as error:
        return [f"{path.name} could not be backed up: {error}"]
    return integrity(copy)
