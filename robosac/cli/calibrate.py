"""``robosac calibrate``: make a detector ready for group testing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from robosac.attacks import ATTACKS
from robosac.calibration import Recipe, ReliabilityBin, calibrate
from robosac.cli.options import DataName, DetectorName, Seed, command, load_detector, progress
from robosac.detectors import DEFAULT_DETECTOR
from robosac.scenes import DEFAULT_DATA

_DEFAULTS = Recipe()


def run(  # the options of a command line
    context: typer.Context,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="The file to write; NAME.calibration.json beside NAME.safetensors is found there."
        ),
    ],
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    attack: Annotated[
        list[str] | None, typer.Option(help=f"A kind of attack: one of {', '.join(ATTACKS)}, or module:callable.")
    ] = None,
    attackers: Annotated[list[int] | None, typer.Option(min=1, help="Attackers at a time.")] = None,
    pose_error: Annotated[
        list[float] | None, typer.Option(min=0.0, help="Standard deviation of the teammates' positions, metres.")
    ] = None,
    scenes: Annotated[int, typer.Option(min=1, help="Validation scenes to fit to.")] = _DEFAULTS.scenes,
    check_scenes: Annotated[int, typer.Option(min=0, help="Further ones to check on.")] = _DEFAULTS.check_scenes,
    stretches: Annotated[
        int, typer.Option(min=1, help="Stretches of two successive frames of each, 2 s apart.")
    ] = _DEFAULTS.stretches_per_scene,
    seed: Seed = _DEFAULTS.seed,
) -> None:
    """Observe what tests show when it is known who attacks, write the likelihoods, and check them.

    Options that may be repeated: --attack (by default pgd, erase, invent and shift), --attackers (1 and 2),
    --pose-error (0, .2, .4).
    """
    torch.set_num_threads(1)
    console = Console()
    chosen = load_detector(detector)
    try:
        recipe = Recipe(
            attacks=tuple(attack or _DEFAULTS.attacks),
            attackers=tuple(attackers or _DEFAULTS.attackers),
            scenes=scenes,
            stretches_per_scene=stretches,
            check_scenes=check_scenes,
            pose_errors_m=tuple(sorted(pose_error or _DEFAULTS.pose_errors_m)),
            seed=seed,
            data=data,
        )
        with progress(console) as bar:
            task = bar.add_task("frames", total=recipe.frames_per_level * len(recipe.pose_errors_m))
            calibration, reliability = calibrate(chosen, recipe, command(context), lambda: bar.advance(task))
        calibration.write(out)
    except (OSError, ValueError) as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    for error_m, bins in reliability.items():
        _print(console, error_m, bins)
    console.print(f"{out}: {calibration.detector}, weights {calibration.weights_digest:.12}...")


def _print(console: Console, pose_error_m: float, bins: list[ReliabilityBin]) -> None:
    table = Table(
        title=f"Suspicion after two frames, pose error {pose_error_m:g} m, scenes held out", title_justify="left"
    )
    for heading in ("suspicion", "teammates", "predicted", "attacked"):
        table.add_column(heading, justify="right")
    for b in bins:
        table.add_row(f"{b.low:g} to {b.high:g}", str(b.teammates), f"{b.predicted:.4f}", f"{b.observed:.4f}")
    console.print(table)
