"""Options that several commands share, and what is made of them before work begins."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from robosac import detectors
from robosac.attacks import Attack, Campaign, lacking
from robosac.cli.blame import blaming
from robosac.detectors import Detector
from robosac.detectors.loading import warm_up
from robosac.scenes import DATA_HELP, WORLDS, SceneSource, World, load_source

DetectorName = Annotated[
    str, typer.Option("--detector", "--weights", help="A detector's name, its weights file, or module:callable.")
]
DataName = Annotated[str, typer.Option("--data", help=DATA_HELP)]
WORLD_HELP = (
    f"one of {', '.join(WORLDS)}, all of them (all), or a scene source of one's own, module:callable; may be repeated."
)
"""What ``--world`` takes."""
MOST_POSE_ERROR_M = 100.0
POSE_ERROR_HELP = "Standard deviation of the teammates' positions, metres."
PoseError = Annotated[float, typer.Option(min=0.0, max=MOST_POSE_ERROR_M, help=POSE_ERROR_HELP)]
TOLD_EVERY_S = 60.0
"""How often it is told how far the work is where no bar can be drawn, as in a file."""
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Of everything random.")]


def load_detector(name: str) -> Detector:
    """The detector of ``--detector``; one of the user's own has answered a frame of zeros."""
    with blaming("--detector", ValueError):
        loaded = detectors.load(name)
        if not type(loaded).__module__.startswith(f"{detectors.__name__}."):
            warm_up(loaded)
        return loaded


def load_data(name: str) -> SceneSource:
    """The scene source of ``--data``."""
    with blaming("--data", ValueError):
        return load_source(name)


def load_worlds(names: Sequence[str]) -> dict[str, SceneSource]:
    """The sources of the worlds that are asked for by ``--world``, by names that a folder may have."""
    asked = dict.fromkeys(each for name in names for each in (WORLDS if name == "all" else [name]))
    folders = {re.sub(r"[^\w.-]", "-", name): name for name in asked}
    with blaming("--world", ValueError):
        if len(folders) < len(asked):
            raise ValueError("two of them would have the same folder")
        return {
            folder: load_source(name if ":" in name else f"{World.kind}:{name}") for folder, name in folders.items()
        }


def check_attack(attack: Attack | Campaign, detector: Detector) -> None:
    """Refuse a detector that lacks what an attack needs."""
    fault = lacking(attack, detector)
    if fault is not None:
        raise typer.BadParameter(fault, param_hint="--detector")


def progress(console: Console, *more: ProgressColumn) -> Progress:
    """A progress bar with a count and times, and more columns if wanted; where none can be drawn, lines."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return _Told(*columns, TimeElapsedColumn(), TimeRemainingColumn(), *more, console=console)


class _Told(Progress):
    """Progress that is also told to a file or a pipe, where rich draws it only once all is done."""

    _told = 0.0

    def start(self) -> None:
        self._told = time.monotonic()
        super().start()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._tell()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        self._tell()

    def _tell(self) -> None:
        if not self.console.is_terminal and time.monotonic() - self._told >= TOLD_EVERY_S:
            self._told = time.monotonic()
            self.console.print(self.get_renderable())


def command(context: typer.Context) -> str:
    """The command that runs, without options that have their defaults; a metavar stands for a value that has one."""
    words = ["robosac", str(context.info_name)]
    options: list[Any] = context.command.params
    for option in options:
        if option.name == "force":  # it makes no difference to what comes of it
            continue
        value = context.params[option.name]
        if value is True:
            words.append(option.opts[0])
        elif value not in (option.default, None, [], ()):
            for each in value if isinstance(value, list | tuple) else [value]:
                words += [option.opts[0], option.metavar or (f"{each:g}" if isinstance(each, float) else str(each))]
    return shlex.join(words)
