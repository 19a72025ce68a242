"""What is wrong with an option is said in a line, before work begins; what fails afterwards is said in a line, too."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager

import typer

from robosac.faults import printable, told


@contextmanager
def blaming(option: str, *errors: type[Exception]) -> Iterator[None]:
    """End the command with a line that says what is wrong with an option, if one of these errors comes up."""
    try:
        yield
    except errors as error:
        raise typer.BadParameter(printable(told(error), lines=True), param_hint=option) from error


@contextmanager
def failing(*errors: type[Exception]) -> Iterator[None]:
    """End the command with 1 and a line that says what went wrong, if one of these errors comes up in its work."""
    try:
        yield
    except errors as error:
        typer.secho(f"Error: {printable(told(error), lines=True)}", fg="red", err=True)
        raise typer.Exit(1) from error


def check_known(names: Collection[str], known: Collection[str], option: str) -> None:
    """Refuse names that are not known."""
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise typer.BadParameter(f"unknown {listed(unknown)}; known: {listed(known)}", param_hint=option)


def listed(names: Iterable[str]) -> str:
    """Names as one types them, one after the other."""
    return ", ".join(map(shlex.quote, names))
