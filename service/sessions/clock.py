"""Whether this gateway's clock may judge what is old."""

from __future__ import annotations

import structlog

from service.keeping.store import Store
from service.sessions.identity import LEEWAY_S

logger = structlog.stdlib.get_logger(__name__)


class Clock:
    """The clock of this gateway, as compared with the one that all gateways on a database share."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._was_right = True

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
