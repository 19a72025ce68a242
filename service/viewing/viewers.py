"""Those who watch a session, and what waits for each of them."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass

WAITING = 8
"""Batches that wait for a viewer who does not read; then the oldest is dropped."""
SILENCE_S = 15.0
"""After so long without news a viewer is told that there are none."""


@dataclass(frozen=True)
class Batch:
    """Frames for all who watch a session."""

    event: bytes
    """As it is sent."""
    frames: int
    """How many."""


class Viewer:
    """Somebody who watches a session: what waits for them is bounded."""

    def __init__(self) -> None:
        self._waiting: deque[Batch] = deque()
        self._news = asyncio.Event()
        self._dropped = 0
        self._over = False

    def offer(self, batch: Batch) -> None:
        """Let a batch wait; the oldest makes room for it where too many do."""
        if len(self._waiting) >= WAITING:
            self._dropped += self._waiting.popleft().frames
        self._waiting.append(batch)
        self._news.set()

    def end(self) -> None:
        """There is nothing more to come."""
        self._over = True
        self._news.set()

    async def batches(self, silence_s: float = SILENCE_S) -> AsyncIterator[tuple[Batch | None, int]]:
        """What comes, each with the number of frames that were dropped before it, until the end.

        None where there was no news for a while.
        """
        while not self._over:
            try:
                async with asyncio.timeout(silence_s):
                    await self._news.wait()
            except TimeoutError:
                yield None, 0
            self._news.clear()
            while self._waiting and not self._over:
                dropped, self._dropped = self._dropped, 0
                yield self._waiting.popleft(), dropped
