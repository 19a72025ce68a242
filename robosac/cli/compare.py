"""``robosac compare``: defences against attacks, on the same frames."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from robosac import defenses, detectors
from robosac.attacks import NoGeometry
from robosac.defenses import Defense
from robosac.detectors import DEFAULT_DETECTOR, Detector
from robosac.evaluation.comparison import (
    DEFENSES,
    FULL,
    QUICK,
    Extent,
    Plan,
    Setting,
    built,
    compare_defenses,
    write_comparison,
)
from robosac.evaluation.comparison.rows import EARLY
from robosac.figures import need_figures
from robosac.scenes.splits import TEST_SEEDS


def run(
    out: Annotated[Path, typer.Option(help="Folder for comparison.md, comparison.csv and two pictures.")],
    quick: Annotated[bool, typer.Option(help="Fewer attacks and frames, in a few minutes.")] = False,
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(DEFENSES)}; may be repeated.")] = None,
    defense: Annotated[
        list[str] | None,
        typer.Option(help="A defence of one's own, module:callable, to be compared too; may be repeated."),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(help="CAMPAIGN:NUMBER of attackers, as in erase@asleep:2; may be repeated."),
    ] = None,
    scenes: Annotated[int | None, typer.Option(min=1, max=len(TEST_SEEDS), help="Test sequences.")] = None,
    frames: Annotated[int | None, typer.Option(min=EARLY + 1, help="Of each sequence, at 5 Hz.")] = None,
    recordings: Annotated[
        Path | None, typer.Option(help="Folder in which recorded frames are kept, to be used again.")
    ] = None,
    pose_error: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of the teammates' positions, metres.")
    ] = 0.0,
    live: Annotated[bool, typer.Option(help="Record nothing: each defence decodes for itself, and is timed.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that share the sequences.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    detector: Annotated[
        str, typer.Option("--detector", "--weights", help="A detector's name, its weights file, or module:callable.")
    ] = DEFAULT_DETECTOR,
) -> None:
    """Play every defence against every attack on the same test sequences, and write tables and pictures."""
    if live and recordings is not None:
        raise typer.BadParameter("nothing is recorded live", param_hint="--recordings")
    need_figures()
    extent = _extent(QUICK if quick else FULL, setting or (), scenes, frames)
    torch.set_num_threads(1)
    console = Console()
    _make_folder(out, "--out")
    if recordings is not None:
        _make_folder(recordings, "--recordings")
    try:
        chosen = detectors.load(detector)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--detector") from error
    plan = Plan(chosen, _defenses(only or (), defense or (), chosen), extent, seed, recordings, pose_error, live)
    started = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("frames", total=len(extent.settings) * extent.scenes * extent.frames)
        try:
            rows = compare_defenses(plan, jobs, lambda: progress.advance(task))
        except NoGeometry as error:
            raise typer.BadParameter(str(error), param_hint="--detector") from error
    given = {
        "--seed": [str(seed)],
        "--only": only,
        "--defense": defense,
        "--quick": quick,
        "--setting": setting,
        "--scenes": scenes,
        "--frames": frames,
        "--recordings": None if recordings is None else "DIR",
        "--pose-error": f"{pose_error:g}" if pose_error else None,
        "--live": live,
        "--jobs": jobs if jobs > 1 else None,
        "--detector": detector if detector != DEFAULT_DETECTOR else None,
    }
    path = write_comparison(rows, plan, out, command(given))
    console.print(f"{path}: {len(rows)} rows in {(time.monotonic() - started) / 60:.1f} minutes")


def command(given: Mapping[str, object]) -> str:
    """The command with these options: lists are repeated, True is a flag, None and False are left out."""
    words = ["robosac", "compare", "--out", "DIR"]
    for option, value in given.items():
        if value is True:
            words.append(option)
        elif value is not None and value is not False:
            for each in value if isinstance(value, list) else [value]:
                words += [option, str(each)]
    return shlex.join(words)


def _defenses(only: Sequence[str], own: Sequence[str], detector: Detector) -> dict[str, Defense]:
    """What is compared, by name: the defences that ship, or only some of them, and one's own."""
    unknown = sorted(set(only) - set(DEFENSES))
    if unknown:
        raise typer.BadParameter(f"unknown {', '.join(unknown)}; known: {', '.join(DEFENSES)}", param_hint="--only")
    chosen = {name: settings for name, settings in DEFENSES.items() if not only or name in only}
    try:
        for name in own:
            if name in DEFENSES:
                raise ValueError(f"{name} ships and has its column: see --only")
            chosen[name] = defenses.load(name)
        return built(chosen, detector)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--defense") from error


def _extent(extent: Extent, settings: list[str] | tuple[()], scenes: int | None, frames: int | None) -> Extent:
    try:
        chosen = tuple(dict.fromkeys(Setting.parse(text) for text in settings))
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--setting") from error
    return replace(
        extent,
        settings=chosen or extent.settings,
        scenes=scenes or extent.scenes,
        frames=frames or extent.frames,
    )


def _make_folder(path: Path, option: str) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(str(error), param_hint=option) from error
