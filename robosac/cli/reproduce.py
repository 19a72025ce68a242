"""``robosac reproduce``: every experiment of the paper, as a report."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from robosac.evaluation.experiments import EXPERIMENTS, FULL, QUICK, Context, Section, write_report
from robosac.figures import need_figures


def run(
    out: Annotated[Path, typer.Option(help="Folder for report.md and the CSV and PNG files beside it.")],
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(EXPERIMENTS)}; may be repeated.")] = None,
    quick: Annotated[bool, typer.Option(help="A small sample of everything, in a few minutes.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
) -> None:
    """Run the paper's experiments on the synthetic intersection and write a report with the paper's numbers beside
    ours.
    """
    unknown = sorted(set(only or ()) - set(EXPERIMENTS))
    if unknown:
        raise typer.BadParameter(f"unknown {', '.join(unknown)}; known: {', '.join(EXPERIMENTS)}", param_hint="--only")
    need_figures()
    torch.set_num_threads(1)
    console = Console()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(str(error), param_hint="--out") from error
    started = time.monotonic()
    columns = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    sections: list[Section] = []
    chosen = [name for name in EXPERIMENTS if not only or name in only]
    with Progress(*columns, console=console) as progress:
        overall = progress.add_task("experiments", total=len(chosen))

        def steps(label: str, total: int) -> Callable[[], None]:
            task = progress.add_task(label, total=total)

            def tick() -> None:
                progress.advance(task)
                if progress.tasks[progress.task_ids.index(task)].finished:
                    progress.remove_task(task)

            return tick

        context = Context(QUICK if quick else FULL, seed, out, steps)
        for name in chosen:
            progress.update(overall, description=name)
            sections.append(EXPERIMENTS[name](context))
            progress.advance(overall)
    options = "".join(f" --only {name}" for name in only or ()) + (" --quick" if quick else "")
    command = f"robosac reproduce --out DIR --seed {seed}{options}"
    path = write_report(sections, out, command, (time.monotonic() - started) / 60)
    console.print(f"{path}: {len(sections)} experiments in {(time.monotonic() - started) / 60:.1f} minutes")
