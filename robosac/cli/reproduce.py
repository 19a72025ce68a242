"""``robosac reproduce``: the paper's experiments."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from robosac.cli.blame import blaming, check_known
from robosac.cli.options import DataName, DetectorName, Seed, command, load_data, load_detector, progress
from robosac.cli.outputs import Force, make_folder, tell
from robosac.detectors import DEFAULT_DETECTOR, EmbeddedDetector
from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS
from robosac.evaluation.experiments import EXPERIMENTS, FULL, HEAD, QUICK, Context
from robosac.evaluation.report import Section, write_report
from robosac.figures import need_figures
from robosac.scenes import DEFAULT_DATA, SceneError

REPORT = "report.md"


def run(  # the options of a command line
    context: typer.Context,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for report.md and the CSV and PNG files beside it.")],
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(EXPERIMENTS)}; may be repeated.")] = None,
    quick: Annotated[bool, typer.Option(help="A small sample of everything, in a few minutes.")] = False,
    seed: Seed = 0,
    detector: DetectorName = DEFAULT_DETECTOR,
    data: DataName = DEFAULT_DATA,
    force: Force = False,
) -> None:
    """Run the paper's experiments and write a report with the paper's numbers beside ours."""
    check_known(only or (), EXPERIMENTS, "--only")
    need_figures()
    torch.set_num_threads(1)
    console = Console()
    make_folder(out, "--out", force, REPORT)
    chosen, source = load_detector(detector), load_data(data)
    hardened = EmbeddedDetector(ADVERSARIAL_WEIGHTS) if detector == DEFAULT_DETECTOR else None
    started = time.monotonic()
    sections: list[Section] = []
    names = [name for name in EXPERIMENTS if not only or name in only]
    with blaming("--data", SceneError), progress(console) as bar:
        overall = bar.add_task("experiments", total=len(names))

        def steps(label: str, total: int) -> Callable[[], None]:
            task = bar.add_task(label, total=total)

            def tick() -> None:
                bar.advance(task)
                if bar.tasks[bar.task_ids.index(task)].finished:
                    bar.remove_task(task)

            return tick

        work = Context(QUICK if quick else FULL, seed, out, chosen, hardened, source, steps)
        for name in names:
            bar.update(overall, description=name)
            sections.append(EXPERIMENTS[name](work))
            bar.advance(overall)
    minutes = (time.monotonic() - started) / 60
    head = HEAD.format(command=command(context), minutes=max(minutes, 1.0))
    path = write_report(out / REPORT, head, sections)
    tell(console, f"{path}: {len(sections)} experiments in {minutes:.1f} minutes")
