"""Draws what a defence does: a frame, a film, suspicion over time, a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from robosac import attacks, defenses
from robosac.attacks import CAMPAIGN_HELP, HONEST, AttackError, Campaign
from robosac.budget import DomainError
from robosac.calibrated import calibration_of
from robosac.cli.blame import blaming, failing
from robosac.cli.options import (
    DataName,
    DetectorName,
    PoseError,
    Seed,
    check_attack,
    load_data,
    load_detector,
    progress,
)
from robosac.cli.outputs import Force, check_file
from robosac.defenses import DefenseSettings
from robosac.detectors import DEFAULT_DETECTOR, DetectorError
from robosac.evaluation.comparison.pictures import TableError, UnknownColumn, draw_heat_map, read_table
from robosac.evaluation.playing import FaultyDefense
from robosac.figures import check_film, check_picture
from robosac.pictures.film import draw_film
from robosac.pictures.frame import draw_frame
from robosac.pictures.moments import Moment, Scenario, moments
from robosac.pictures.suspicion import draw_suspicion
from robosac.scenes import DEFAULT_DATA, SceneError, one_scene
from robosac.session import default_defense

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)

Picture = Annotated[Path, typer.Option(help="The picture; the suffix chooses the format (png, svg, pdf).")]
AttackName = Annotated[str, typer.Option(help=CAMPAIGN_HELP)]
Attackers = Annotated[int, typer.Option(min=0, help="Attackers among the ego's teammates.")]
DefenseName = Annotated[
    str | None,
    typer.Option(help=f"{', '.join(defenses.shipped())}, or module:callable; by default that of a new session."),
]
SceneNumber = Annotated[int, typer.Option("--scene", min=0, help="Which test scene, counted from 0.")]
FramesOfSequence = Annotated[int, typer.Option(min=1, help="Of the sequence, from its first on.")]


@app.command("frame")
def frame(  # the options of a command line
    out: Picture,
    number: Annotated[
        int, typer.Option("--frame", min=0, help="Which frame, counted from 0; all before it are played first.")
    ] = 1,
    attack: AttackName = "pgd",
    attackers: Attackers = 1,
    defense: DefenseName = None,
    scene: SceneNumber = 0,
    pose_error: PoseError = 0.0,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    force: Force = False,
) -> None:
    """Draw a frame: the answer, the team, and every hypothesis with its verdict and the evidence on its boxes."""
    with blaming("--out", ValueError):
        check_picture(out)
    check_file(out, "--out", force)
    sequence, settings = _chosen(detector, data, scene, attack, attackers, number + 1, defense, seed, pose_error)
    shown = _played(sequence, settings)[number]
    with blaming("--out", OSError, ValueError):  # matplotlib names the formats it knows
        draw_frame(shown, out, f"{sequence.title}; frame {number}, {settings.kind}")
    tests = len(shown.result.hypotheses)
    many = "1 test" if tests == 1 else f"{tests} tests"
    typer.echo(f"{out}: {len(shown.found)} boxes answered after {many}, {_named(shown)}")


@app.command("film")
def film(  # the options of a command line
    out: Annotated[Path, typer.Option(help="The film: NAME.gif, or NAME.mp4 where ffmpeg is installed.")],
    frames: FramesOfSequence = 20,
    attack: AttackName = "pgd",
    attackers: Attackers = 1,
    defense: DefenseName = None,
    scene: SceneNumber = 0,
    fps: Annotated[int | None, typer.Option(min=1, max=50, help="Frames a second; by default as they were.")] = None,
    pose_error: PoseError = 0.0,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    force: Force = False,
) -> None:
    """Draw a sequence as a film: what is seen without a defence beside what is answered with it."""
    with blaming("--out", ValueError):
        check_film(out)
    check_file(out, "--out", force)
    sequence, settings = _chosen(detector, data, scene, attack, attackers, frames, defense, seed, pose_error)
    shown = _played(sequence, settings)
    with blaming("--out", OSError):
        as_it_was = max(1, round(1 / sequence.scene.frame_period_s))
        draw_film(shown, out, sequence.title, settings.kind, fps=fps or as_it_was)
    typer.echo(f"{out}: {frames} frames, {out.stat().st_size / 2**20:.2f} MiB; in the last one {_named(shown[-1])}")


@app.command("suspicion")
def suspicion(  # the options of a command line
    out: Picture,
    frames: FramesOfSequence = 25,
    attack: AttackName = "pgd",
    attackers: Attackers = 1,
    defense: DefenseName = None,
    scene: SceneNumber = 0,
    pose_error: PoseError = 0.0,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    force: Force = False,
) -> None:
    """Draw suspicion of each teammate over time, and who is fused, left out and named in which frame."""
    with blaming("--out", ValueError):
        check_picture(out)
    check_file(out, "--out", force)
    sequence, settings = _chosen(detector, data, scene, attack, attackers, frames, defense, seed, pose_error)
    shown = _played(sequence, settings)
    with blaming("--out", OSError, ValueError):
        draw_suspicion(shown, out, f"{sequence.title}; {settings.kind}")
    typer.echo(f"{out}: {frames} frames; in the last one {_named(shown[-1])}")


@app.command("comparison")
def comparison(
    table: Annotated[Path, typer.Argument(help="comparison.csv, as robosac compare writes it.")],
    out: Picture,
    column: Annotated[str, typer.Option(help="Which figure of the table.")] = "ap70",
    force: Force = False,
) -> None:
    """Draw a figure of a comparison as a heat map: a line for each attack, a column for each defence."""
    with blaming("--out", ValueError):
        check_picture(out)
    check_file(out, "--out", force, table)
    with blaming("TABLE", OSError, TableError), blaming("--column", UnknownColumn):
        heat = read_table(table, column)
    with blaming("--out", OSError, ValueError):
        draw_heat_map(heat, out)
    typer.echo(f"{out}: {len(heat.texts)} figures")


def _chosen(  # the options of a command line
    detector: str,
    data: str,
    scene: int,
    attack: str,
    attackers: int,
    frames: int,
    defense: str | None,
    seed: int,
    pose_error: float,
) -> tuple[Scenario, DefenseSettings]:
    """What is to be played, checked before it is."""
    torch.set_num_threads(1)
    with blaming("--attack", ValueError):
        campaign = attacks.load_campaign(attack)
    chosen, source = load_detector(detector), load_data(data)
    check_attack(campaign if attackers else Campaign(None), chosen)
    with blaming("--defense", DomainError):
        settings = default_defense(chosen.info) if defense is None else defenses.load(defense)
        defenses.build(settings, lambda: calibration_of(chosen.info))
    with blaming("--data", SceneError):
        count = len(source.scenes("test"))
        if scene >= count:
            raise typer.BadParameter(f"{source.name} has {count} test scenes, counted from 0", param_hint="--scene")
        where = one_scene(source, "test", scene, frames)
    team = len(where.agents) - 1
    if attackers > team:
        raise typer.BadParameter(f"the scene has {team} teammates, not {attackers}", param_hint="--attackers")
    what = attack if attackers else HONEST
    return Scenario(chosen, source, where, what, attackers, frames, seed, pose_error), settings


def _played(sequence: Scenario, settings: DefenseSettings) -> list[Moment]:
    """The frames, answered."""
    with failing(AttackError, DetectorError), blaming("--data", SceneError), progress(Console(stderr=True)) as bar:
        task = bar.add_task("frames", total=sequence.frames)
        met = sequence.met(lambda: bar.advance(task))
    with failing(FaultyDefense, DetectorError, DomainError):
        return moments(sequence, met, settings)


def _named(shown: Moment) -> str:
    if shown.result.named is None:
        return f"{len(shown.result.accepted)} teammates fused"
    return f"named: {', '.join(shown.named) or 'nobody'}"
