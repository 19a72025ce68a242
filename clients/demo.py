"""A gateway and a hostile fleet, from start to end: ``robosac demo``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from clients import trial
from clients.fleet import FleetOptions, close_run, run_fleet
from clients.local_gateway import local_gateway
from clients.summary import REPORT, FleetSummary

CLEAN_SHARE = 0.95


def main(
    report: Annotated[Path, typer.Option(help="Folder for the summary, the picture and the gateway's log.")],
    scenes: Annotated[int, typer.Option(min=1, help="Sequences.")] = 8,
    frames: Annotated[int, typer.Option(min=1, help="Frames of a sequence.")] = 25,
    force: trial.Force = False,
) -> None:
    """Start a gateway, drive six vehicles through it, one of them a PGD attacker, and show what came of it.

    Exits with 1 if anything failed, or if the attacker got into more than 5 % of the answers.
    """
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(report, "--report", REPORT, force, for_pictures=True)
    options, summary = trial.run(_run(report, scenes, frames, console), console, "The demo")
    close_run(options, summary, console)
    if summary.clean_share < CLEAN_SHARE:
        console.print(f"[red]The demo failed:[/red] expected no attacker in at least {CLEAN_SHARE:.0%} of the answers.")
        sys.exit(1)


async def _run(report: Path, scenes: int, frames: int, console: Console) -> tuple[FleetOptions, FleetSummary]:
    console.print("Starting the gateway (uvicorn service.app:app) ...")
    async with local_gateway(report / "gateway.log") as url:
        console.print(
            f"It is ready at {url}. Six vehicles, one of them a PGD attacker, post at 5 Hz of simulated time."
        )
        options = FleetOptions(url=url, scenes=scenes, frames=frames, report=report)
        return options, await run_fleet(options, console)


if __name__ == "__main__":
    typer.run(main)
