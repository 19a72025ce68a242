"""``robosac benign-scores``: what honest teammates look like to a detector."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from robosac.cli.blame import blaming
from robosac.cli.options import DataName, DetectorName, load_data, load_detector, progress
from robosac.cli.outputs import Force, check_file, tell
from robosac.detectors import DEFAULT_DETECTOR
from robosac.evaluation.benign_scores import single_teammate_indices
from robosac.files import write_text
from robosac.scenes import DEFAULT_DATA, first_scenes

DIGITS = 3


def run(
    out: Annotated[Path, typer.Option(help="JSON file for the Jaccard indices.")],
    scenes: Annotated[int, typer.Option(min=1, help="Validation scenes.")] = 60,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    force: Force = False,
) -> None:
    """Measure the Jaccard indices of honest single teammates: the calibration of the defence `conformal`."""
    torch.set_num_threads(1)
    console = Console()
    check_file(out, "--out", force)
    chosen, source = load_detector(detector), load_data(data)
    with blaming("--data", ValueError), progress(console) as bar:
        wanted = first_scenes(source, "validation", scenes)
        task = bar.add_task("scenes", total=scenes)
        indices = single_teammate_indices(chosen, wanted, lambda: bar.advance(task))
    write_text(out, json.dumps([round(index, DIGITS) for index in indices]) + "\n")
    tell(console, f"{out}: {len(indices)} Jaccard indices")
