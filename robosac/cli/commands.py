"""The commands by name; each is imported when it runs, since most take seconds to import.

Other packages add commands by the entry point group ``robosac.commands``, so that nothing here has to know them.
"""

from __future__ import annotations

import ast
import errno
import inspect
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from robosac.cli.outputs import spell_what_can_be
from robosac.extras import MissingExtra
from robosac.faults import foreign_place, in_one_line

OWN = {
    "scene": "robosac.cli.scene:run",
    "show": "robosac.cli.show:app",
    "train": "robosac.cli.train:run",
    "evaluate": "robosac.cli.evaluate:run",
    "benign-scores": "robosac.cli.benign_scores:run",
    "reproduce": "robosac.cli.reproduce:run",
    "compare": "robosac.cli.compare:run",
    "calibrate": "robosac.cli.calibrate:run",
    "witness": "robosac.cli.witness:run",
    "convert-checkpoint": "robosac.cli.convert:run",
    "audit": "robosac.cli.audit:app",
}
"""Commands of the library, each ``module:attribute``: a function, or a typer application with commands of its own."""
GROUP = "robosac.commands"
"""Entry points of other packages' commands, in the same form."""
UNWRITTEN = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""How writing fails where there is no room."""
READ_NO_MORE = 128 + signal.SIGPIPE
"""Status where nobody reads what is printed, as of whatever a shell runs: the outcome is unknown."""
_OURS = ("robosac", "service", "clients")


def places() -> dict[str, str]:
    """All commands, the library's own first; nobody else can take one of its names."""
    others = {point.name: f"{point.module}:{point.attr}" for point in entry_points(group=GROUP)}
    return OWN | {name: others[name] for name in sorted(others) if name not in OWN}


def summary(place: str) -> str:
    """The first paragraph of a command's docstring, or of its module's where the command is no function.

    The module is read and not imported. What cannot be read has no summary.
    """
    module, _, attribute = place.partition(":")
    try:
        spec = find_spec(module)
        tree = ast.parse(Path(spec.origin).read_bytes()) if spec and spec.origin else ast.Module([], [])
    except (ImportError, OSError, SyntaxError):
        return ""
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    text = ast.get_docstring(functions.get(attribute, tree)) or ""
    return " ".join(text.partition("\n\n")[0].split())


def load(name: str, place: str) -> Any:
    """The command at a place."""
    found = resolve_name(place)
    if not isinstance(found, typer.Typer):
        function, found = found, typer.Typer(add_completion=False)
        found.command(name)(function)
    command = typer.main.get_command(found)
    command.name = name
    for each in (command, *getattr(command, "commands", {}).values()):
        each.help = _in_paragraphs(each.help)
    return command


def _in_paragraphs(text: str | None) -> str | None:
    """A help text of which each paragraph is one line: typer breaks it where the docstring's lines end, too."""
    return text and "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(text).split("\n\n"))


class Commands(TyperGroup):
    """A group whose commands are stand-ins, made real once one is chosen.

    Contexts and commands are ``Any`` below, since it depends on the version of typer whose classes they are.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._places = places()
        self.commands = {name: TyperCommand(name) for name in self._places}

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            command.help = summary(self._places[cmd_name])
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else load(name, self._places[name]), rest

    def main(self, *args: Any, **settings: Any) -> Any:
        """Run a command; where what it prints cannot be written, end with 2, as 1 may be the outcome of a check."""
        try:
            return super().main(*args, **settings)
        except OSError as error:
            if error.errno not in UNWRITTEN or error.filename is not None:
                raise
            _print_nowhere()
            typer.echo(f"Error: {error.strerror}", err=True)
            sys.exit(2)
        except SystemExit as ended:
            if isinstance(ended.__context__, BrokenPipeError):  # of which rich makes a 1, in --help
                sys.exit(READ_NO_MORE)
            raise

    def invoke(self, ctx: Any) -> Any:
        words = [*ctx._protected_args, *ctx.args]
        spell_what_can_be()
        try:
            return super().invoke(ctx)
        except typer.BadParameter as refused:
            refused.param_hint = _as_typed(refused, words)
            raise
        except BrokenPipeError as closed:  # of which typer makes a 1, as if a check had failed
            _print_nowhere()
            raise typer.Exit(READ_NO_MORE) from closed
        except MissingExtra as missing:
            typer.echo(f"Error: {missing}", err=True)
            raise typer.Exit(2) from missing
        except Exception as error:
            ends = type(error).__module__.partition(".")[0] in ("typer", "click")  # Exit and the like
            below = error.__traceback__ and error.__traceback__.tb_next  # this very line called no code of the user's
            place = None if ends else foreign_place(below, _OURS)
            if place is None:
                raise
            typer.secho(f"Error: {place}: {in_one_line(error)}", fg="red", err=True)
            raise typer.Exit(1) from error


def _print_nowhere() -> None:
    """Let what is left of the output not fail again at the very end."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _as_typed(refused: Any, words: Sequence[str]) -> Any:
    """The option that an error is about, by that of its names which the user wrote."""
    options: list[Any] = refused.ctx.command.params if refused.ctx else []
    names: list[str] = next((option.opts for option in options if refused.param_hint in option.opts), [])
    written = [name for name in names for word in words if word.partition("=")[0] == name]
    return written[0] if written else refused.param_hint
