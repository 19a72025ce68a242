"""Work that pauses, so that the work of others can take turns with it."""

from __future__ import annotations

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
