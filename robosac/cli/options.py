"""Options that several commands share, and what is made of them before work begins."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from robosac import detectors
from robosac.attacks import Attack, Campaign, lacking
from robosac.cli.blame import blaming
from robosac.detectors import Detector
from robosac.scenes import DATA_HELP, SOURCES, SceneSource

DetectorName = Annotated[
    str, typer.Option("--detector", "--weights", help="A detector's name, its weights file, or module:callable.")
]
DataName = Annotated[str, typer.Option("--data", help=DATA_HELP)]
Seed = Annotated[int, typer.Option(min=0, help="Of everything random.")]


def load_detector(name: str) -> Detector:
    """The detector of ``--detector``."""
    with blaming("--detector", ValueError):
        return detectors.load(name)


def load_data(name: str) -> SceneSource:
    """The scene source of ``--data``."""
    with blaming("--data", ValueError):
        return SOURCES.make(name)


def check_attack(attack: Attack | Campaign, detector: Detector) -> None:
    """Refuse a detector that lacks what an attack needs."""
    fault = lacking(attack, detector)
    if fault is not None:
        raise typer.BadParameter(fault, param_hint="--detector")


def progress(console: Console, *more: ProgressColumn) -> Progress:
    """A progress bar with a count and times, and more columns if wanted."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), *more, console=console)


def command(name: str, given: Mapping[str, object]) -> str:
    """The command with these options: lists are repeated, True is a flag, None and False are left out."""
    words = ["robosac", *name.split()]
    for option, value in given.items():
        if value is True:
            words.append(option)
        elif value is not None and value is not False:
            for each in value if isinstance(value, list | tuple) else [value]:
                words += [option, f"{each:g}" if isinstance(each, float) else str(each)]
    return shlex.join(words)
