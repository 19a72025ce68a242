"""Work that pauses, so that the work of others can take turns with it."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Steps = Generator[None, None, T]
"""Work that pauses before each of its larger parts."""


def finished(steps: Steps[T]) -> T:
    """What work comes to that is done without a pause."""
    try:
        while True:
            next(steps)
    except StopIteration as stop:
        result: T = stop.value
        return result
