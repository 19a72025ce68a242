"""What is seen of a fleet while it drives."""

from __future__ import annotations

from collections import deque
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from clients.simulation import EgoFrame
from clients.standing import shown
from robosac.answers import FrameAnswer, Reason

RECENT = 12


class Screen:
    """The live table."""

    def __init__(self, console: Console, total: int) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console
        )
        self._task = self._progress.add_task("frames", total=total)
        self._rows: deque[tuple[str, ...]] = deque(maxlen=RECENT)
        self.live = Live(self._render(), console=console, refresh_per_second=8, transient=True)

    def add(self, scene: int, frame: EgoFrame, answer: FrameAnswer, latency_ms: float) -> None:
        """Show one answered frame; attackers are red."""

        def names(vehicles: Any) -> str:
            return " ".join(f"[red]{v}[/red]" if v in frame.attackers else v for v in vehicles) or "-"

        dissent = [v for v, entry in answer.rejected.items() if entry.reason is Reason.DISSENSUS]
        best = max((h.jaccard_index for h in answer.hypotheses), default=float("nan"))
        self._rows.append(
            (
                str(scene),
                str(answer.frame),
                frame.ego_id,
                answer.source.replace("_", " "),
                names(answer.accepted),
                names(dissent),
                shown(answer),
                str(answer.sampling_steps),
                f"{best:.2f}",
                f"{latency_ms:.0f}",
            )
        )
        self._progress.advance(self._task)
        self.live.update(self._render())

    def _render(self) -> Group:
        table = Table()
        for heading in (
            "scene",
            "frame",
            "ego",
            "source",
            "accepted",
            "in dissensus",
            "boxes",
            "steps",
            "best J",
            "ms",
        ):
            is_number = heading in ("scene", "frame", "boxes", "steps", "best J", "ms")
            table.add_column(heading, justify="right" if is_number else "left")
        for row in self._rows:
            table.add_row(*row)
        return Group(table, self._progress)
