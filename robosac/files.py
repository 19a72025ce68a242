"""Files that are whole or not there: written beside their place, and put into it at the end."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside ``path`` to write to, which takes its place after the block; folders above it are made.

    If the block fails, or the process is killed in it, what was at ``path`` is still there. What is no regular file,
    such as ``/dev/null``, is written to as it is.

    Parameters
    ----------
    path : Path
        Where a link points to is replaced, not the link.

    Raises
    ------
    OSError
        If the folder cannot be made, or the file cannot be put into its place.
    """
    place = Path(os.path.realpath(path))
    if is_special(place):
        yield place
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    beside = place.with_name(f".{token_hex(4)}.{place.name}")  # the suffix stays: it tells matplotlib the format
    try:
        yield beside
        with beside.open("rb") as written:
            os.fsync(written.fileno())
        beside.replace(place)
    finally:
        beside.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises
    ------
    OSError
        If it cannot be made, as where there is a file of that name.
    """
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{path} is a file; a folder is wanted")
    path.mkdir(parents=True, exist_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file by `replacing`."""
    with replacing(path) as beside:
        beside.write_text(text)


def is_special(path: Path) -> bool:
    """Whether there is something that is neither a regular file nor a folder: a device, a pipe."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
