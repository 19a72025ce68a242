"""``robosac compare``: defences against attacks, on the same frames."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from robosac import detectors
from robosac.attacks import NoGeometry
from robosac.detectors import DEFAULT_DETECTOR
from robosac.evaluation.comparison import DEFENSES, FULL, QUICK, compare_defenses, write_comparison


def run(
    out: Annotated[Path, typer.Option(help="Folder for comparison.md, comparison.csv and two pictures.")],
    quick: Annotated[bool, typer.Option(help="Fewer attacks and frames, in a few minutes.")] = False,
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(DEFENSES)}; may be repeated.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    detector: Annotated[
        str, typer.Option("--detector", "--weights", help="A detector's name, its weights file, or module:callable.")
    ] = DEFAULT_DETECTOR,
) -> None:
    """Play every defence against every attack on the same test sequences, and write tables and pictures."""
    unknown = sorted(set(only or ()) - set(DEFENSES))
    if unknown:
        raise typer.BadParameter(f"unknown {', '.join(unknown)}; known: {', '.join(DEFENSES)}", param_hint="--only")
    torch.set_num_threads(1)
    console = Console()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(str(error), param_hint="--out") from error
    try:
        chosen = detectors.load(detector)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--detector") from error
    extent = QUICK if quick else FULL
    started = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("frames", total=len(extent.settings) * extent.scenes * extent.frames)
        defenses = {name: make(chosen) for name, make in DEFENSES.items() if not only or name in only}
        try:
            rows = compare_defenses(chosen, defenses, extent, seed, lambda: progress.advance(task))
        except NoGeometry as error:
            raise typer.BadParameter(str(error), param_hint="--detector") from error
    options = "".join(f" --only {name}" for name in only or ()) + (" --quick" if quick else "")
    if detector != DEFAULT_DETECTOR:
        options += f" --detector {detector}"
    path = write_comparison(rows, extent, out, f"robosac compare --out DIR --seed {seed}{options}")
    console.print(f"{path}: {len(rows)} rows in {(time.monotonic() - started) / 60:.1f} minutes")
