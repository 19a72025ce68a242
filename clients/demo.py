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
from robosac.cli import outputs

CLEAN_SHARE = 0.95


def main(
    report: Annotated[Path, typer.Option(help="Folder for the summary, the picture and the gateway's log.")],
    scenes: Annotated[int, typer.Option(min=1, help="Sequences.")] = 8,
    frames: Annotated[int, typer.Option(min=1, help="Frames of a sequence.")] = 25,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to record the sessions to, with what is true.")
    ] = None,
    force: trial.Force = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Drive at 5 Hz, and go on after the summary until Ctrl-C.")
    ] = False,
) -> None:
    """Start a gateway, drive six vehicles through it, one of them a PGD attacker, and show what came of it.

    Prints the address of the page where it can be watched. Exits with 1 if anything failed, or if the attacker got into
    more than 5 % of the answers.
    """
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(report, "--report", REPORT, force, for_pictures=True)
    if record is not None:
        outputs.make_folder(record, "--record")
    try:
        summary = trial.run(run(report, scenes, frames, console, watch=watch, record=record), console, "The demo")
    except KeyboardInterrupt:
        if not watch:
            raise
        return
    if summary.clean_share < CLEAN_SHARE:
        console.print(f"[red]The demo failed:[/red] expected no attacker in at least {CLEAN_SHARE:.0%} of the answers.")
        sys.exit(1)


async def run(
    report: Path, scenes: int, frames: int, console: Console, *, watch: bool = False, record: Path | None = None
) -> FleetSummary:
    """As `main`; to be watched it goes on until it is cancelled."""
    settings = {} if record is None else {"ROBOSAC_RECORD": str(record.absolute())}
    console.print("Starting the gateway (uvicorn service.app:app) ...")
    async with local_gateway(report / "gateway.log", settings=settings) as url:
        console.print(
            f"It is ready at {url}. Six vehicles, one of them a PGD attacker, post at 5 Hz of simulated time."
        )
        console.print(f"Watch it live: {url}/")
        told = record is not None
        options = FleetOptions(url, scenes, frames, report=report, real_time=watch, truth=told)
        summary = await run_fleet(options, console)
        close_run(options, summary, console)
        if watch:
            console.print(f"The fleet drives on, from the first scene again, until Ctrl-C. Watch it live: {url}/")
        while watch:
            await run_fleet(options, console)
    if record is not None:
        outputs.tell(console, f"Recorded: robosac record info {record}")
    return summary


if __name__ == "__main__":
    typer.run(main)
