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
from robosac.calibration.messages import add, measure
from robosac.cli.options import DataName, DetectorName, Seed, command, load_detector, progress
from robosac.detectors import DEFAULT_DETECTOR, Detector
from robosac.scenes import DEFAULT_DATA, SOURCES, first_scenes

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
    messages_only: Annotated[
        bool,
        typer.Option("--messages-only", help="Measure only what honest messages hold, and put that into FILE."),
    ] = False,
) -> None:
    """Observe what tests show when it is known who attacks, write the likelihoods, and check them.

    Options that may be repeated: --attack (by default pgd, erase, invent and shift), --attackers (1 and 2),
    --pose-error (0, .2, .4).
    """
    torch.set_num_threads(1)
    console = Console()
    chosen = load_detector(detector)
    if messages_only:
        _measure_messages(chosen, data, scenes, out, command(context), console)
        return
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
        _measure_messages(chosen, data, scenes, out, command(context), console)
    except (OSError, ValueError) as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    for error_m, bins in reliability.items():
        _print(console, error_m, bins)
    console.print(f"{out}: {calibration.detector}, weights {calibration.weights_digest:.12}...")
    if chosen.info.witness is None:
        console.print("Single objects can be judged, too, once robosac witness has made NAME.witness.safetensors.")


def _measure_messages(detector: Detector, data: str, scenes: int, out: Path, made_by: str, console: Console) -> None:
    """Add what honest messages hold to the calibration in a file."""
    try:
        chosen = first_scenes(SOURCES.make(data), "validation", scenes)
        with progress(console) as bar:
            task = bar.add_task("messages", total=scenes)
            measured = measure(detector, chosen, tick=lambda: bar.advance(task))
        add(out, detector.info.weights_digest, measured, made_by)
    except (OSError, ValueError) as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    for name, bounds in measured.items():
        console.print(
            f"{name}: at most {bounds.largest:g}, root mean square {bounds.rms:g}; "
            f"successive maps of one that stands still are alike up to {bounds.still:g}"
        )


def _print(console: Console, pose_error_m: float, bins: list[ReliabilityBin]) -> None:
    table = Table(
        title=f"Suspicion after two frames, pose error {pose_error_m:g} m, scenes held out", title_justify="left"
    )
    for heading in ("suspicion", "teammates", "predicted", "attacked"):
        table.add_column(heading, justify="right")
    for b in bins:
        table.add_row(f"{b.low:g} to {b.high:g}", str(b.teammates), f"{b.predicted:.4f}", f"{b.observed:.4f}")
    console.print(table)
