"""The ``robosac`` command."""

from __future__ import annotations

from importlib import metadata
from typing import Annotated

import typer

from robosac.cli import audit, benign_scores, calibrate, compare, convert, evaluate, reproduce, scene, train


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(metadata.version("robosac"))
        raise typer.Exit


app = typer.Typer(no_args_is_help=True, add_completion=False, help="Consensus-verified collaborative perception.")


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Print the version and end.")
    ] = False,
) -> None:
    """Consensus-verified collaborative perception."""


app.command("scene")(scene.run)
app.command("train")(train.run)
app.command("evaluate")(evaluate.run)
app.command("benign-scores")(benign_scores.run)
app.command("reproduce")(reproduce.run)
app.command("compare")(compare.run)
app.command("calibrate")(calibrate.run)
app.command("convert-checkpoint")(convert.run)
app.add_typer(audit.app, name="audit")

__all__ = ["app"]
