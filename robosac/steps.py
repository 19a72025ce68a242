"""Work that pauses, so that the work of others can take turns with it."""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any, TypeVar

T = TypeVar("T")
Steps = Generator[Any, None, T]
"""Work that pauses before each of its larger parts. What it yields may tell what comes (`robosac.passes.Pass`)."""


def finished(steps: Steps[T]) -> T:
    """What work comes to that is done without a pause."""
    try:
        while True:
            next(steps)
    except StopIteration as stop:
        result: T = stop.value
        return result


def done_within(steps: Steps[T], seconds: float) -> tuple[T] | None:
    """What work comes to that is begun or gone on with for about so long, until the pause after that; None if it is not
    over by then.
    """
    until = time.perf_counter() + seconds
    try:
        while True:
            next(steps)
            if time.perf_counter() >= until:
                return None
    except StopIteration as stop:
        return (stop.value,)
