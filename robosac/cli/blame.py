"""What is wrong with an option is said in a line, before work begins."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer


@contextmanager
def blaming(option: str, *errors: type[Exception]) -> Iterator[None]:
    """End the command with a line that says what is wrong with an option, if one of these errors comes up."""
    try:
        yield
    except errors as error:
        raise typer.BadParameter(str(error), param_hint=option) from error


def make_folder(path: Path, option: str) -> None:
    """Make an output folder."""
    with blaming(option, OSError):
        path.mkdir(parents=True, exist_ok=True)


def check_known(names: Collection[str], known: Collection[str], option: str) -> None:
    """Refuse names that are not known."""
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise typer.BadParameter(f"unknown {', '.join(unknown)}; known: {', '.join(known)}", param_hint=option)
