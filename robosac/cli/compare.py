"""``robosac compare``: defences against attacks, on the same frames."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from robosac import defenses
from robosac.attacks import KIND as ATTACKS
from robosac.attacks import AttackError, lacking, load_campaign
from robosac.budget import DomainError
from robosac.calibrated import without_witness
from robosac.cli.blame import blaming, check_known, failing, listed
from robosac.cli.options import (
    WORLD_HELP,
    DataName,
    DetectorName,
    PoseError,
    Seed,
    command,
    load_data,
    load_detector,
    load_worlds,
    progress,
)
from robosac.cli.outputs import Force, make_folder, tell
from robosac.defenses import Defense
from robosac.detectors import DEFAULT_DETECTOR, Detector, DetectorError
from robosac.detectors.loading import DETECTORS
from robosac.evaluation.comparison import (
    DEFENSES,
    FULL,
    QUICK,
    Extent,
    Plan,
    Row,
    Setting,
    built,
    compare_plans,
    kept,
    lacks_witness,
    write_comparison,
    write_worlds,
)
from robosac.evaluation.comparison.report import REPORT
from robosac.evaluation.comparison.rows import EARLY
from robosac.evaluation.comparison.worlds import WORLDS_REPORT
from robosac.evaluation.playing import FaultyDefense
from robosac.figures import need_figures
from robosac.plugins import code_of
from robosac.scenes import DEFAULT_DATA, SOURCES, SceneError, SceneSource

UNFINISHED = "unfinished"
"""Folder beside the report in which sequences are kept until all are played."""


def run(  # the options of a command line
    context: typer.Context,
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for comparison.md, comparison.csv and two pictures; with --world for one such folder a world, "
            "worlds.md and worlds.csv.",
        ),
    ],
    quick: Annotated[bool, typer.Option(help="Fewer attacks and frames, in a few minutes.")] = False,
    only: Annotated[list[str] | None, typer.Option(help=f"One of {listed(DEFENSES)}; may be repeated.")] = None,
    defense: Annotated[
        list[str] | None,
        typer.Option(help="A defence of one's own, module:callable, to be compared too; may be repeated."),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(help="CAMPAIGN:NUMBER of attackers, as in erase@asleep:2; may be repeated."),
    ] = None,
    scenes: Annotated[
        int | None, typer.Option(min=1, help=f"Test sequences; {FULL.scenes}, or {QUICK.scenes} if quick.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=EARLY + 1, help=f"Of each sequence; {FULL.frames}, or {QUICK.frames} if quick.")
    ] = None,
    recordings: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder in which recorded frames are kept, to be used again.")
    ] = None,
    pose_error: PoseError = 0.0,
    live: Annotated[bool, typer.Option(help="Record nothing: each defence decodes for itself, and is timed.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that share the sequences.")] = 1,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    world: Annotated[list[str] | None, typer.Option(help=f"A world to play all of this in: {WORLD_HELP}")] = None,
    force: Force = False,
) -> None:
    """Play every defence against every attack on the same test sequences, and write tables and pictures. If it is
    stopped, the same command goes on from the sequences that are played.
    """
    if live and recordings is not None:
        raise typer.BadParameter("nothing is recorded live", param_hint="--recordings")
    need_figures()
    extent = _extent(QUICK if quick else FULL, setting or (), scenes, frames)
    torch.set_num_threads(1)
    console = Console()
    if world and data != DEFAULT_DATA:
        raise typer.BadParameter("--world says where scenes come from; --data does, too", param_hint="--world")
    chosen, sources = load_detector(detector), load_worlds(world) if world else {"": load_data(data)}
    if setting:
        _check_teams(sources, extent, "--world" if world else "--data")
    reports = [str(Path(name, REPORT)) for name in sources] + ([WORLDS_REPORT] if world else [])
    make_folder(out, "--out", force, *reports)
    if recordings is not None:
        make_folder(recordings, "--recordings")
    columns, left_out = _defenses(only or (), defense or (), chosen)
    possible, impossible = _possible(extent, chosen, asked=bool(setting))
    for why in (*left_out, *impossible):
        tell(console, f"Left out: {why}")
    if lacks_witness(columns):
        console.print(f"{without_witness(chosen.info.name)}.", markup=False)
    extent = replace(extent, settings=possible)
    what = (chosen, columns, extent, seed, recordings, pose_error, live)
    code = code_of(ATTACKS, DETECTORS, SOURCES)
    plans = {name: Plan(*what, source, out / name / UNFINISHED, code) for name, source in sources.items()}
    with blaming("--out", ValueError, OSError):
        before = sum(kept.begin(plan) for plan in plans.values())
    if before:
        console.print(f"Going on: {before} of {len(plans) * extent.scenes} sequences were played before")
    started = time.monotonic()
    try:
        blamed = blaming("--world" if world else "--data", SceneError)
        with failing(AttackError, DetectorError, FaultyDefense, DomainError, OSError), blamed, progress(console) as bar:
            task = bar.add_task("frames", total=len(plans) * len(extent.settings) * extent.scenes * extent.frames)
            found = compare_plans(list(plans.values()), jobs, lambda: bar.advance(task))
        with failing(OSError):
            path = _write(dict(zip(plans, found, strict=True)), plans, out, command(context))
            for plan in plans.values():
                kept.end(plan)
    except KeyboardInterrupt:
        console.print("Stopped. The same command goes on from the sequences that are played.")
        raise typer.Exit(130) from None
    rows = sum(len(each) for each in found)
    tell(console, f"{path}: {rows} rows in {(time.monotonic() - started) / 60:.1f} minutes")


def _write(rows: Mapping[str, Sequence[Row]], plans: Mapping[str, Plan], out: Path, line: str) -> Path:
    """The report of each world in its folder, and that of all; without worlds the only one there is."""
    for name, plan in plans.items():
        path = write_comparison(rows[name], plan, out / name, line)
    return path if "" in plans else write_worlds(rows, plans, out, line)


def _possible(extent: Extent, detector: Detector, asked: bool) -> tuple[tuple[Setting, ...], list[str]]:
    """The settings that the detector can be attacked in, and why others are left out; to ask for one of those fails."""
    faults = {setting: lacking(load_campaign(setting.campaign), detector) for setting in extent.settings}
    impossible = [f"{setting.label}: {fault}" for setting, fault in faults.items() if fault]
    if impossible and (asked or len(impossible) == len(faults)):
        raise typer.BadParameter("; ".join(impossible), param_hint="--detector")
    return tuple(setting for setting, fault in faults.items() if not fault), impossible


def _check_teams(sources: Mapping[str, SceneSource], extent: Extent, option: str) -> None:
    """Refuse a setting with more attackers than a scene has teammates."""
    most = max(extent.settings, key=lambda setting: setting.attackers)
    for source in sources.values():
        with blaming(option, SceneError):
            scenes = source.scenes("test")[: extent.scenes]
            team = min((len(scene.agents) - 1 for scene in scenes), default=most.attackers)
        if most.attackers > team:
            why = f"{most.campaign}:{most.attackers}: a scene of {source.name} has {team} teammates"
            raise typer.BadParameter(why, param_hint="--setting")


def _defenses(only: Sequence[str], own: Sequence[str], detector: Detector) -> tuple[dict[str, Defense], list[str]]:
    """What is compared, by name: the defences that ship, or only some of them, and one's own.

    Those that the detector is not calibrated for are left out, and it is said why; to ask for one of them fails.
    """
    check_known(only, DEFENSES, "--only")
    chosen = {name: settings for name, settings in DEFENSES.items() if not only or name in only}
    with blaming("--defense", ValueError):
        for name in own:
            if name in DEFENSES:
                raise ValueError(f"{name} ships and has its column: see --only")
            chosen[name] = defenses.load(name)
        defenses.known(own)  # a log names the kind alone
        made, left_out = built(chosen, detector)
    reasons = [f"{name}: {why}" for name, why in left_out.items()]
    for option, asked in (("--only", only), ("--defense", own)):
        if not left_out.keys().isdisjoint(asked):
            raise typer.BadParameter("; ".join(reasons), param_hint=option)
    return made, reasons


def _extent(extent: Extent, settings: list[str] | tuple[()], scenes: int | None, frames: int | None) -> Extent:
    with blaming("--setting", ValueError):
        chosen = tuple(dict.fromkeys(Setting.parse(text) for text in settings))
    return replace(
        extent,
        settings=chosen or extent.settings,
        scenes=scenes or extent.scenes,
        frames=frames or extent.frames,
    )
