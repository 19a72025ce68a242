"""``robosac evaluate``: the table of bounds."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from robosac import attacks
from robosac.attacks import CAMPAIGN_HELP, AttackError
from robosac.cli.blame import blaming, failing
from robosac.cli.options import DataName, DetectorName, Seed, check_attack, load_data, load_detector, progress
from robosac.cli.outputs import Force, make_folder, tell
from robosac.detectors import DEFAULT_DETECTOR, DetectorError
from robosac.evaluation import BoundsReport, NoFrames, Sampling, evaluate_bounds
from robosac.evaluation.frames import evaluation_frames
from robosac.files import write_text
from robosac.scenes import DEFAULT_DATA, SceneError

DEFAULT_SCENES = 40
REPORT = "bounds.json"


def run(  # the options of a command line
    scenes: Annotated[int | None, typer.Option(min=1, help="Test scenes; 40, or all if there are fewer.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each, 1 s apart.")] = 5,
    attackers: Annotated[int, typer.Option(min=0, help="Attackers among the teammates.")] = 1,
    attack: Annotated[str, typer.Option(help=CAMPAIGN_HELP)] = "pgd",
    collaborators: Annotated[int, typer.Option(min=1, help="Teammates in a hypothesis.")] = 3,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    out: Annotated[Path | None, typer.Option(help=f"Folder for {REPORT}.")] = None,
    force: Force = False,
) -> None:
    """Average precision of Algorithm 1 between its bounds, and the error rates of the consensus test."""
    torch.set_num_threads(1)
    console = Console()
    if out is not None:
        make_folder(out, "--out", force, REPORT)
    with blaming("--attack", ValueError):
        chosen_attack = attacks.load_campaign(attack)
    chosen, source = load_detector(detector), load_data(data)
    check_attack(chosen_attack, chosen)
    rng = np.random.default_rng([seed, 0])
    with failing(AttackError, DetectorError), blaming("--data", SceneError, NoFrames), progress(console) as bar:
        some = source.scenes("test")[: scenes or DEFAULT_SCENES]
        if len(some) < (scenes or 1):
            raise SceneError(f"{source.name} has {len(some)} test scenes; {scenes or 1} are wanted")
        team = max((len(scene.agents) - 1 for scene in some), default=0)
        if attackers > team:
            raise typer.BadParameter(f"a scene has at most {team} teammates, not {attackers}", param_hint="--attackers")
        if attackers + collaborators > team:
            why = f"no {collaborators} of {team} teammates can be free of {attackers} attackers"
            raise typer.BadParameter(why, param_hint="--collaborators")
        met = evaluation_frames(chosen, some, frames, chosen_attack, attackers, rng, attackers + collaborators)
        task = bar.add_task("frames", total=len(some) * frames)
        sampling = Sampling(attackers, team, collaborators, seed=seed)
        report = evaluate_bounds(met, chosen_attack, sampling, lambda: bar.advance(task))
    _print(console, report, attack, attackers)
    if out is not None:
        settings = {
            "scenes": len(some),
            "frames": frames,
            "attackers": attackers,
            "attack": attack,
            "collaborators": collaborators,
            "seed": seed,
            "detector": chosen.info.name,
            "weights_digest": chosen.info.weights_digest,
            "data": data,
        }
        text = json.dumps({"settings": settings, **asdict(report)}, indent=2, allow_nan=False)
        write_text(out / REPORT, text + "\n")
        tell(console, f"Written: {out / REPORT}")


def _print(console: Console, report: BoundsReport, attack: str, attackers: int) -> None:
    table = Table(
        title=Text(f"{report.frames} test frames, {attackers} attacker(s): {attack}"),
        title_justify="left",
    )
    for heading in ("perception", "AP50", "AP70", "steps", "success", "infiltrated"):
        names = heading == "perception"  # on a narrow terminal names are broken, and no figure is cut off
        table.add_column(heading, justify="left" if names else "right", no_wrap=not names, overflow="fold")
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
