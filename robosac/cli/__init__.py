"""The ``robosac`` command."""

from __future__ import annotations

from typing import Annotated

import typer

import robosac
from robosac.cli.commands import Commands


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(robosac.__version__)
        raise typer.Exit


app = typer.Typer(cls=Commands, no_args_is_help=True, help="Consensus-verified collaborative perception.")


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Print the version and end.")
    ] = False,
) -> None:
    """Consensus-verified collaborative perception."""


__all__ = ["app"]
