"""``robosac calibrate``: make a detector ready for group testing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from robosac.attacks import ATTACKS
from robosac.calibrated import without_witness
from robosac.calibration import Recipe, ReliabilityBin, TooFewVerdicts, calibrate
from robosac.calibration.making import load_attacks
from robosac.calibration.messages import add, held, measure
from robosac.calibration.reliability import Reliability, add_worlds, check_in
from robosac.cli.blame import blaming, failing
from robosac.cli.options import (
    MOST_POSE_ERROR_M,
    POSE_ERROR_HELP,
    WORLD_HELP,
    DataName,
    DetectorName,
    Seed,
    command,
    load_data,
    load_detector,
    load_worlds,
    progress,
)
from robosac.cli.outputs import Force, check_file, tell
from robosac.defenses.group_testing import Calibration, CalibrationError
from robosac.detectors import DEFAULT_DETECTOR, Detector, Encoder
from robosac.files import replacing
from robosac.plugins import lacks
from robosac.scenes import DEFAULT_DATA, Scene, SceneError, SceneSource, first_scenes

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
        list[float] | None, typer.Option(min=0.0, max=MOST_POSE_ERROR_M, help=POSE_ERROR_HELP)
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
    world: Annotated[
        list[str] | None, typer.Option(help=f"A world to check the suspicion in as well: {WORLD_HELP}")
    ] = None,
    worlds_only: Annotated[
        bool, typer.Option("--worlds-only", help="Only check the calibration in FILE in every --world.")
    ] = False,
    force: Force = False,
) -> None:
    """Observe what tests show when it is known who attacks, write the likelihoods, and check them.

    Options that may be repeated: --attack (by default pgd, erase, invent and shift), --attackers (1 and 2),
    --pose-error (0, .2, .4), --world (none).
    """
    torch.set_num_threads(1)
    console = Console()
    if messages_only and worlds_only:
        raise typer.BadParameter("give one of them, or neither", param_hint="--messages-only, --worlds-only")
    if worlds_only and not world:
        raise typer.BadParameter("say which", param_hint="--world")
    if not (messages_only or worlds_only):
        check_file(out, "--out", force)
    chosen, source, worlds = load_detector(detector), load_data(data), load_worlds(world or ())
    if missing := lacks(chosen, Encoder if messages_only else Detector):
        why = f"{chosen.info.name} cannot be calibrated: it {missing}"
        raise typer.BadParameter(why, param_hint="--detector")
    if messages_only or worlds_only:
        with blaming("--out", CalibrationError):
            held(out, chosen.info.weights_digest)
    if worlds_only:
        _check_worlds(chosen, worlds, check_scenes, out, command(context), console)
        return
    with blaming("--data", SceneError):
        honest = first_scenes(source, "validation", scenes)
    if messages_only:
        with failing(OSError, ValueError):
            _measure_messages(chosen, honest, out, command(context), console)
        return
    with blaming("--attackers", ValueError):
        recipe = Recipe(
            attacks=tuple(dict.fromkeys(attack or _DEFAULTS.attacks)),
            attackers=tuple(attackers or _DEFAULTS.attackers),
            scenes=scenes,
            stretches_per_scene=stretches,
            check_scenes=check_scenes,
            pose_errors_m=tuple(sorted(pose_error or _DEFAULTS.pose_errors_m)),
            seed=seed,
            data=data,
        )
    with blaming("--attack", ValueError):
        load_attacks(chosen, recipe.attacks)
    too_few = blaming("--scenes", TooFewVerdicts)
    with failing(OSError, ValueError), too_few, blaming("--data", SceneError), replacing(out) as beside:
        with progress(console) as bar:
            task = bar.add_task("frames", total=recipe.frames_per_level * len(recipe.pose_errors_m))
            calibration, reliability = calibrate(chosen, recipe, command(context), lambda: bar.advance(task))
        calibration.write(beside)
        _measure_messages(chosen, honest, beside, command(context), console)
        _check_worlds(chosen, worlds, check_scenes, beside, command(context), console)
    for error_m, bins in reliability.items():
        _print(console, error_m, bins)
    tell(console, f"{out}: {calibration.detector}, weights {calibration.weights_digest:.12}...")
    if chosen.info.witness is None:
        console.print(f"{without_witness(chosen.info.name)}.", markup=False)


def _measure_messages(detector: Encoder, scenes: Sequence[Scene], out: Path, made_by: str, console: Console) -> None:
    """Add what honest messages hold to the calibration in a file."""
    with progress(console) as bar:
        task = bar.add_task("messages", total=len(scenes))
        measured = measure(detector, scenes, tick=lambda: bar.advance(task))
    add(out, detector.info.weights_digest, measured, made_by)
    for name, bounds in measured.items():
        console.print(
            f"{name}: at most {bounds.largest:g}, root mean square {bounds.rms:g}; "
            f"successive maps of one that stands still are alike up to {bounds.still:g}"
        )


def _check_worlds(
    detector: Detector, worlds: Mapping[str, SceneSource], scenes: int, path: Path, made_by: str, console: Console
) -> None:
    """Check the calibration in a file in each world, and add what that shows to it."""
    if not worlds:
        return
    calibration = replace(Calibration.read(path), witnessed=detector.info.witness is not None)
    found: dict[str, Reliability] = {}
    with failing(OSError), blaming("--world", SceneError, ValueError), progress(console) as bar:
        task = bar.add_task("worlds", total=len(worlds))
        for name, source in worlds.items():
            found[name] = check_in(detector, calibration, source, scenes)
            bar.advance(task)
    add_worlds(path, detector.info.weights_digest, found, made_by)
    table = Table(title=f"Suspicion after two frames, {scenes} scenes of each world", title_justify="left")
    for heading in ("world", "honest", "suspected", "attackers", "suspected", "calibration error"):
        table.add_column(heading, justify="left" if heading == "world" else "right")
    for name, each in found.items():
        counts = (each.honest, each.honest_suspected, each.attackers, each.attackers_suspected)
        table.add_row(Text(name), *map(str, counts), f"{each.error:.3f}")
    console.print(table)


def _print(console: Console, pose_error_m: float, bins: list[ReliabilityBin]) -> None:
    table = Table(
        title=f"Suspicion after two frames, pose error {pose_error_m:g} m, scenes held out", title_justify="left"
    )
    for heading in ("suspicion", "teammates", "predicted", "attacked"):
        table.add_column(heading, justify="right")
    for b in bins:
        table.add_row(f"{b.low:g} to {b.high:g}", str(b.teammates), f"{b.predicted:.4f}", f"{b.observed:.4f}")
    console.print(table)
