"""``robosac benign-scores``: what honest teammates look like to a detector."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import Progress

from robosac import detectors
from robosac.detectors import DEFAULT_DETECTOR
from robosac.evaluation.benign_scores import single_teammate_indices
from robosac.scenes.splits import VALIDATION_SEEDS

DIGITS = 3


def run(
    out: Annotated[Path, typer.Option(help="JSON file for the Jaccard indices.")],
    scenes: Annotated[int, typer.Option(min=1, max=len(VALIDATION_SEEDS), help="Validation scenes.")] = 60,
    detector: Annotated[
        str, typer.Option(help="A detector's name, its weights file, or module:callable.")
    ] = DEFAULT_DETECTOR,
) -> None:
    """Measure the Jaccard indices of honest single teammates: the calibration of the defence `conformal`."""
    torch.set_num_threads(1)
    console = Console()
    try:
        chosen = detectors.load(detector)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--detector") from error
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.touch()
    except OSError as error:
        raise typer.BadParameter(str(error), param_hint="--out") from error
    with Progress(console=console) as progress:
        task = progress.add_task("scenes", total=scenes)
        indices = single_teammate_indices(chosen, VALIDATION_SEEDS[:scenes], lambda: progress.advance(task))
    out.write_text(json.dumps([round(index, DIGITS) for index in indices]) + "\n")
    console.print(f"{out}: {len(indices)} Jaccard indices")
