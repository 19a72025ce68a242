"""Kinds of work compared turn by turn, in one process, by the processor time they take."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

Work = Callable[[], object]


@dataclass(frozen=True)
class Row:
    """Something measured, in units of something else that was measured in the same turns."""

    what: str
    low: float
    middle: float
    high: float
    """Quartiles, by the median of what it is compared with."""
    of: str

    def cells(self) -> tuple[str, ...]:
        """For a table."""
        spread = f"{self.low:.2f} to {self.high:.2f}" if self.low < self.high else ""
        return self.what, f"{self.middle:.2f}", spread, self.of


@dataclass(frozen=True)
class Part:
    """A table of the report."""

    title: str
    text: str
    rows: Sequence[Row] = field(default_factory=list)

    def markdown(self) -> str:
        """A section."""
        lines = ["| | times | quartiles | of |", "|---|---|---|---|"]
        lines += ["| " + " | ".join(row.cells()) + " |" for row in self.rows]
        return "\n".join([f"## {self.title}", "", self.text, "", *lines, ""])


def in_turns(work: Mapping[str, Work], turns: int) -> dict[str, list[float]]:
    """Seconds of processor time of each kind of work, after one turn that does not count."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(turns + 1):
        for name, function in work.items():
            began = time.process_time()
            function()
            if turn:
                times[name].append(time.process_time() - began)
    return times


def rows(times: Mapping[str, Sequence[float]], of: str) -> list[Row]:
    """All but one kind of work, in units of that one."""
    base = float(np.median(times[of]))
    return [row(name, spent, base, of) for name, spent in times.items() if name != of]


def row(what: str, spent: Sequence[float], base: float, of: str) -> Row:
    """One kind of work, in units of a base."""
    low, middle, high = (float(value) / base for value in np.quantile(spent, (0.25, 0.5, 0.75)))
    return Row(what, low, middle, high, of)
