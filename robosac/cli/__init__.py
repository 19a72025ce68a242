"""The ``robosac`` command."""

from __future__ import annotations

import typer

from robosac.cli import evaluate, reproduce, scene, train

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Consensus-verified collaborative perception.")
app.command("scene")(scene.run)
app.command("train")(train.run)
app.command("evaluate")(evaluate.run)
app.command("reproduce")(reproduce.run)

__all__ = ["app"]
