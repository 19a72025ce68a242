"""``robosac train``: make the embedded detector's weights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from robosac.detectors.embedded import NAME
from robosac.training.export import export_weights
from robosac.training.loop import TrainingConfig, train_network
from robosac.training.validation import GAINS, choose_operating_point

_DEFAULTS = TrainingConfig()


def run(
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint and the weights.")],
    seed: Annotated[int, typer.Option(help="Of the initial weights and of every draw.")] = _DEFAULTS.seed,
    steps: Annotated[int, typer.Option(min=100, help="Optimiser steps.")] = _DEFAULTS.steps,
    scenes: Annotated[int, typer.Option(min=1, help="Training scenes, five frames each.")] = _DEFAULTS.scenes,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
) -> None:
    """Train the embedded detector on generated scenes. Run it again with the same options to go on after a break."""
    torch.set_num_threads(threads)
    config = TrainingConfig(seed=seed, steps=steps, scenes=scenes)
    out.mkdir(parents=True, exist_ok=True)
    weights = out / f"{NAME}.safetensors"
    console = Console()
    columns = (
        TextColumn("{task.description:<9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, TextColumn("{task.fields[remark]}"), console=console) as progress:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int, remark: str) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, remark="")
            progress.update(tasks[stage], completed=done, remark=remark)

        try:
            network = train_network(config, out / "checkpoint.pt", show)
        except ValueError as error:
            console.print(f"[red]{error}[/red]")
            raise typer.Exit(1) from error
        validating = progress.add_task("validate", total=len(GAINS), remark="choosing the feature gain")
        point = choose_operating_point(network, lambda: progress.advance(validating))
        progress.update(validating, completed=len(GAINS), remark="")
    command = f"robosac train --out DIR --seed {seed} --steps {steps} --scenes {scenes}"
    recipe = export_weights(network, config, point, command, weights)
    console.print(f"{weights}: {weights.stat().st_size / 1e6:.2f} MB")
    console.print_json(
        data={key: recipe[key] for key in ("feature_gain", "consensus_score", "validation", "tensors_sha256")}
    )
