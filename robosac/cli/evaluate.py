"""``robosac evaluate``: the table of bounds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from robosac import attacks, detectors
from robosac.attacks import CAMPAIGN_HELP, Campaign, NoGeometry
from robosac.detectors import DEFAULT_DETECTOR, Detector, V2XSimDetector
from robosac.evaluation import BoundsReport, NoFrames, evaluate_bounds
from robosac.evaluation.bounds import TEAM_SIZE
from robosac.evaluation.frames import EvaluationFrame, evaluation_frames, v2xsim_frames
from robosac.scenes import FRAMES_PER_SECOND, v2xsim
from robosac.scenes.splits import TEST_SEEDS
from robosac.scenes.v2xsim import SampleError


def run(
    scenes: Annotated[int, typer.Option(min=1, help="Test scenes, the first so many.")] = 40,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each, 1 s apart.")] = 5,
    attackers: Annotated[int, typer.Option(min=0, max=5, help="Attackers among the five teammates.")] = 1,
    attack: Annotated[str, typer.Option(help=CAMPAIGN_HELP)] = "pgd",
    collaborators: Annotated[int, typer.Option(min=1, max=5, help="Teammates in a hypothesis.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    detector: Annotated[
        str,
        typer.Option("--detector", "--weights", help="A detector's name, its weights file, or module:callable."),
    ] = DEFAULT_DETECTOR,
    data: Annotated[
        Path | None, typer.Option(help="Folder of V2X-Sim samples (agent0, agent1, ...) instead of synthetic scenes.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for bounds.json.")] = None,
) -> None:
    """Average precision of Algorithm 1 between its bounds, and the error rates of the consensus test."""
    torch.set_num_threads(1)
    console = Console()
    if attackers + collaborators > TEAM_SIZE:
        raise typer.BadParameter(
            f"no {collaborators} of five teammates can be free of {attackers} attackers", param_hint="--collaborators"
        )
    with _blaming("--out", OSError):
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
    with _blaming("--attack", ValueError):
        chosen_attack = attacks.load_campaign(attack)
    with _blaming("--weights", ValueError):
        chosen = detectors.load(detector)
    rng = np.random.default_rng([seed, 0])
    if data is None:
        total, source = _synthetic(chosen, scenes, frames, chosen_attack, attackers, rng)
    else:
        total, source = _v2xsim(chosen, data, scenes, frames, chosen_attack, attackers, collaborators, rng)
    with (
        _blaming("--attack", NoGeometry),
        _blaming("--data", SampleError, NoFrames),
        Progress(console=console) as progress,
    ):
        task = progress.add_task("frames", total=total)
        report = evaluate_bounds(
            chosen,
            source,
            chosen_attack,
            attackers=attackers,
            collaborators=collaborators,
            seed=seed,
            tick=lambda: progress.advance(task),
        )
    _print(console, report, attack, attackers)
    if out is not None:
        settings = {
            "scenes": scenes,
            "frames": frames,
            "attackers": attackers,
            "attack": attack,
            "collaborators": collaborators,
            "seed": seed,
            "detector": chosen.info.name,
            "weights_digest": chosen.info.weights_digest,
            "data": "synthetic" if data is None else "v2x-sim",
        }
        text = json.dumps({"settings": settings, **asdict(report)}, indent=2, allow_nan=False)
        (out / "bounds.json").write_text(text + "\n")
        console.print(f"Written: {out / 'bounds.json'}")


@contextmanager
def _blaming(option: str, *errors: type[Exception]) -> Iterator[None]:
    try:
        yield
    except errors as error:
        raise typer.BadParameter(str(error), param_hint=option) from error


_Source = tuple[int, Iterator[EvaluationFrame | None]]


def _synthetic(
    detector: Detector, scenes: int, frames: int, attack: Campaign, attackers: int, rng: np.random.Generator
) -> _Source:
    """How many frames, and the frames."""
    if scenes > len(TEST_SEEDS):
        raise typer.BadParameter(f"there are {len(TEST_SEEDS)} test scenes", param_hint="--scenes")
    return scenes * frames, evaluation_frames(detector, TEST_SEEDS[:scenes], frames, attack, attackers, rng)


def _v2xsim(
    detector: Detector,
    root: Path,
    scenes: int,
    frames: int,
    attack: Campaign,
    attackers: int,
    collaborators: int,
    rng: np.random.Generator,
) -> _Source:
    if not isinstance(detector, V2XSimDetector):
        raise typer.BadParameter(
            f"V2X-Sim samples need a V2X-Sim detector, not {detector.info.name}: give the weights that "
            "robosac convert-checkpoint wrote",
            param_hint="--weights",
        )
    listed = v2xsim.scenes(root)
    if not listed:
        raise typer.BadParameter(f"no folder agent*/<scene>_<frame> in {root}", param_hint="--data")
    chosen = list(listed)[:scenes]
    total = sum(len(listed[scene][::FRAMES_PER_SECOND][:frames]) for scene in chosen)
    return total, v2xsim_frames(detector, root, chosen, frames, attack, attackers, collaborators, rng)


def _print(console: Console, report: BoundsReport, attack: str, attackers: int) -> None:
    table = Table(
        title=f"{report.frames} test frames, {attackers} {attack.upper()} attacker(s) of five teammates",
        title_justify="left",
    )
    for heading in ("perception", "AP50", "AP70", "steps", "success", "infiltrated"):
        table.add_column(
            heading, justify="left" if heading == "perception" else "right", no_wrap=heading == "perception"
        )
    for row in report.rows:
        table.add_row(
            row.name,
            f"{row.ap50:.3f}",
            f"{row.ap70:.3f}",
            "" if row.mean_steps is None else f"{row.mean_steps:.2f}",
            "" if row.success_rate is None else f"{row.success_rate:.3f}",
            "" if row.infiltrated is None else f"{row.infiltrated:.3f}",
        )
    console.print(table)
    if report.skipped:
        console.print(f"Skipped {report.skipped} frames with too few teammates.")
    for rate, error, count, kind in (
        (report.false_alarm_rate, "false alarms", report.benign_hypotheses, "attacker-free"),
        (report.miss_rate, "misses", report.attacked_hypotheses, "attacked"),
    ):
        if rate is not None:
            console.print(f"Consensus test: {rate:.2%} {error} ({count} {kind} hypotheses).")
    if report.perturbation_to_feature_ratio is not None:
        console.print(
            f"The perturbation's bound is {report.perturbation_to_feature_ratio:.2f} times the 95th percentile of the "
            "magnitude of benign messages; it is added to the message, before the ego warps it."
        )
