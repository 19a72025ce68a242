"""``robosac evaluate``: the table of bounds."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from robosac.attacks import ATTACKS
from robosac.detectors import EmbeddedDetector, WeightsError
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.evaluation import BoundsReport, evaluate_bounds
from robosac.scenes.splits import TEST_SEEDS


def run(
    scenes: Annotated[int, typer.Option(min=1, max=len(TEST_SEEDS), help="Test scenes, from seed 0 on.")] = 40,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each, 1 s apart.")] = 5,
    attackers: Annotated[int, typer.Option(min=0, max=5, help="Attackers among the five teammates.")] = 1,
    attack: Annotated[str, typer.Option(help=f"One of {', '.join(ATTACKS)}.")] = "pgd",
    collaborators: Annotated[int, typer.Option(min=1, max=5, help="Teammates in a hypothesis.")] = 3,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
    weights: Annotated[Path, typer.Option(help="Weights of the embedded detector.")] = SHIPPED_WEIGHTS,
    out: Annotated[Path | None, typer.Option(help="Folder for bounds.json.")] = None,
) -> None:
    """Average precision of Algorithm 1 between its bounds, and the error rates of the consensus test."""
    torch.set_num_threads(1)
    console = Console()
    if attack not in ATTACKS:
        raise typer.BadParameter(f"unknown attack {attack!r}; known: {', '.join(ATTACKS)}", param_hint="--attack")
    if attackers + collaborators > 5:
        raise typer.BadParameter(
            f"no {collaborators} of five teammates can be free of {attackers} attackers", param_hint="--collaborators"
        )
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(str(error), param_hint="--out") from error
    try:
        detector = EmbeddedDetector(weights)
    except WeightsError as error:
        raise typer.BadParameter(str(error), param_hint="--weights") from error
    with Progress(console=console) as progress:
        task = progress.add_task("frames", total=scenes * frames)
        report = evaluate_bounds(
            detector,
            ATTACKS[attack](),
            seeds=TEST_SEEDS[:scenes],
            frames_per_scene=frames,
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
            "weights_digest": detector.info.weights_digest,
        }
        text = json.dumps({"settings": settings, **asdict(report)}, indent=2, allow_nan=False)
        (out / "bounds.json").write_text(text + "\n")
        console.print(f"Written: {out / 'bounds.json'}")


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
    for rate, error, count, kind in (
        (report.false_alarm_rate, "false alarms", report.benign_hypotheses, "attacker-free"),
        (report.miss_rate, "misses", report.attacked_hypotheses, "attacked"),
    ):
        if rate is not None:
            console.print(f"Consensus test: {rate:.2%} {error} ({count} {kind} hypotheses).")
    console.print(
        f"The perturbation's bound is {report.perturbation_to_feature_ratio:.2f} times the 95th percentile of the "
        "magnitude of benign messages; it is added to the message, before the ego warps it."
    )
