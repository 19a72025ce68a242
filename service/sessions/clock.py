"""Whether this gateway's clock may judge what is old."""

from __future__ import annotations

import time
from collections import deque

import structlog

from service.keeping.store import Store
from service.sessions.identity import LEEWAY_S

logger = structlog.stdlib.get_logger(__name__)

MOST_STEPS = 1024


class Clock:
    """The clock of this gateway, as compared with the one that all gateways on a database share, and with itself."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._was_right = True
        self._offset_s = time.time() - time.monotonic()
        self._steps: deque[tuple[float, float]] = deque(maxlen=MOST_STEPS)

    def stepped_s(self, within_s: float) -> float:
        """By how many seconds the clock was set forward in the last so many; the log tells of each time.

        What was written before may look older by as much. A step is seen by comparison with the last call.
        """
        now, offset_s = time.monotonic(), time.time() - time.monotonic()
        step_s, self._offset_s = offset_s - self._offset_s, offset_s
        if step_s > LEEWAY_S:
            self._steps.append((now, step_s))
            logger.warning(
                f"the clock was set forward by {step_s:.0f} s: "
                "no log is purged and no idle session is ended for looking older by that"
            )
        return sum(step_s for seen_at, step_s in self._steps if seen_at >= now - within_s)

    async def is_right(self) -> bool:
        """Whether it is within `LEEWAY_S` of the database's; the log tells of a change."""
        ahead_s = await self._store.ahead_s()
        right = abs(ahead_s) <= LEEWAY_S
        if self._was_right and not right:
            side = "ahead of" if ahead_s > 0 else "behind"
            logger.warning(
                f"the clock is {abs(ahead_s):.0f} s {side} the database's: "
                "no idle session is ended and no log is purged here until it is right"
            )
        elif right and not self._was_right:
            logger.info("the clock is right again")
        self._was_right = right
        return right
