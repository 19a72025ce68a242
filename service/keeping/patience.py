"""Who waits for the store, and how long: a decision is kept only while somebody waits for it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from service.errors import GivenUp

T = TypeVar("T")

GRACE_S = 0.25
"""How long after the end of its budget a frame waits for the store, or for the frame before it."""


async def within(reading: Coroutine[Any, Any, T], seconds: float) -> T:
    """What is read, if that takes no longer.

    Else the read goes on by itself: to cancel it would cost its connection.

    Raises
    ------
    TimeoutError
    """
    task = asyncio.create_task(reading)
    await asyncio.wait({task}, timeout=seconds)
    if task.done():
        return task.result()
    task.add_done_callback(ask_for_the_exception)
    raise TimeoutError


def ask_for_the_exception(task: asyncio.Task[Any]) -> None:
    """So that the loop does not complain that nobody did; the database has logged its failure."""
    if not task.cancelled():
        task.exception()


class Patience:
    """Lets either of two threads have the last word on a write: the one that waits for it, or the one that does it.

    The writer asks at the end of its transaction, before the commit. From then on nobody can give up, and whoever waits
    has to find out what came of it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._given_up = False
        self._committing = False

    def give_up(self) -> bool:
        """Wait no longer; whether that was in time, so that nothing is kept."""
        with self._lock:
            self._given_up = not self._committing
            return self._given_up

    def check(self) -> None:
        """Begin no work for nobody.

        Raises
        ------
        GivenUp
        """
        if self._given_up:
            raise GivenUp

    def commit(self) -> None:
        """Let nobody give up from now on.

        Raises
        ------
        GivenUp
            If somebody has.
        """
        with self._lock:
            if self._given_up:
                raise GivenUp
            self._committing = True
