"""Where a command may write. No command overwrites what is there unless it is told to, and it says so before its work.

Of a folder of reports the page or summary counts: a folder without one may hold anything else, such as what a run that
was interrupted has left.
"""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from robosac import files
from robosac.cli.blame import blaming

Force = Annotated[bool, typer.Option("--force", help="Overwrite what an earlier run has written.")]


def spell_what_can_be() -> None:
    """Let a terminal or file that has not every character show a question mark instead of ending the command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def tell(console: Console, line: str) -> None:
    """Print a line that names a file: as it is and whole, since a name of which something is missing is no file's."""
    console.print(Text(line), soft_wrap=True)


def check_file(path: Path, option: str, force: bool, *inputs: Path) -> None:
    """Refuse a file that is there already or could not be written, and by whatever name one of those that are read; the
    folder for it is made.
    """
    if path.is_file() and any(one.is_file() and path.samefile(one) for one in inputs):
        raise typer.BadParameter(f"{path} is what is to be read", param_hint=option)
    _refuse_existing(path, option, force)
    with blaming(option, OSError):
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder")
        make_folder(path.parent, option)


def make_folder(path: Path, option: str, force: bool = False, *reports: str) -> None:
    """Make a folder for reports; refuse one that holds any of these already, or that cannot be written to."""
    for report in reports:
        _refuse_existing(path / report, option, force)
    with blaming(option, OSError):
        files.make_folder(path)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(f"{path} cannot be written to")


def _refuse_existing(path: Path, option: str, force: bool) -> None:
    if not force and os.path.lexists(path) and not path.is_dir() and not files.is_special(path):
        raise typer.BadParameter(f"{path} is there already; --force overwrites it", param_hint=option)
