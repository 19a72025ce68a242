"""The command line of the crash test."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track

from clients import trial
from clients.crash_test.rounds import Incident, Kill, Rounds, possible
from clients.load_test import prepare

REPORT = "crash_test.json"
PREPARED_FRAMES = 4
DATABASES = ("sqlite", "postgresql", "postgresql+asyncpg")


def show(console: Console, sessions: int, kills: Sequence[Kill]) -> None:
    """Print what came of it."""
    restarts = np.percentile([kill.restart_s for kill in kills], [50, 95, 100])
    table = trial.a_table(f"{len(kills)} kills, {sessions} sessions", ["", ""])
    for incident in Incident:
        table.add_row(f"rounds: {incident.value}", str(sum(kill.incident is incident for kill in kills)))
    table.add_row("frames acknowledged", str(sum(kill.acknowledged for kill in kills)))
    table.add_row("decided, the answer lost with the gateway", str(sum(kill.unacknowledged for kill in kills)))
    table.add_row("refused (503)", str(sum(kill.refused for kill in kills)))
    table.add_row("kills after which anything was wrong", str(sum(bool(kill.wrong) for kill in kills)))
    table.add_row("restart, s: p50, p95, max", ", ".join(f"{value:.1f}" for value in restarts))
    console.print(table)
    for number, kill in enumerate(kills, 1):
        for complaint in kill.wrong:
            console.print(f"kill {number} ({kill.incident.value}): {complaint}", style="red", markup=False)


def checked_database(url: str | None) -> str | None:
    """The URL of a database that gateways take, as an option has it. It is not shown, as it may hold a password."""
    if url is not None:
        kind, found, _ = url.partition("://")
        if not found:
            raise typer.BadParameter("not a database URL")
        if kind not in DATABASES:
            raise typer.BadParameter(f"a database must be one of {', '.join(DATABASES)}, not {kind}")
    return url


def main(
    kills: Annotated[int, typer.Option(min=1, help="Rounds; each ends with a kill.")] = 21,
    sessions: Annotated[int, typer.Option(min=1, help="Sessions, with one defence after another.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the moments.")] = 0,
    incidents: Annotated[
        list[Incident] | None, typer.Option("--incident", help="What happens in the rounds; by default all in turn.")
    ] = None,
    database_url: Annotated[
        str | None, typer.Option(callback=checked_database, help="By default SQLite in a temporary folder.")
    ] = None,
    out: trial.Out = None,
    force: trial.Force = False,
) -> None:
    """Kill gateways under load again and again, and check that nothing acknowledged is lost.

    Exits with 1 if anything was wrong.
    """
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(out, "--out", REPORT, force)
    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        url = database_url or f"sqlite:///{folder}/robosac.db"
        if not set(incidents or ()) <= set(possible(url)):
            raise typer.BadParameter("only a SQLite file is backed up", param_hint="--incident")
        bodies = prepare(True, 3, console, PREPARED_FRAMES)
        rounds = Rounds(url, (out or Path(folder)) / "gateway.log", bodies, np.random.default_rng(seed))
        done = trial.run(_run(rounds, incidents or possible(url), kills, sessions, console), console, "The crash test")
    show(console, sessions, done)
    report = {"seed": seed, "sessions": sessions, "kills": [asdict(kill) for kill in done]}
    trial.write(report, out, REPORT, console)
    if any(kill.wrong for kill in done):
        sys.exit(1)


async def _run(
    rounds: Rounds, incidents: Sequence[Incident], kills: int, sessions: int, console: Console
) -> list[Kill]:
    try:
        await rounds.open(sessions)
        return [
            await rounds.play(incidents[number % len(incidents)])
            for number in track(range(kills), "kills", console=console, transient=True)
        ]
    finally:
        await rounds.stop()


if __name__ == "__main__":
    typer.run(main)
