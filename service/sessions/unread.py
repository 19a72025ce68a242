"""Bodies of a vehicle that are not whole yet: only so many, and one that stands still gives way to one that comes."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from service.errors import Kind, Refused

BODIES = 8
"""Of one vehicle at a time."""


class Unread:
    """The bodies of one vehicle that are not whole yet, the one of which nothing has come for longest first.

    Whoever has only stolen the vehicle's token may send as many as they like: they push out their own, and none of the
    vehicle's, as long as its bytes keep coming.
    """

    def __init__(self) -> None:
        self._bodies: OrderedDict[asyncio.Timeout, None] = OrderedDict()

    @asynccontextmanager
    async def one_more(self) -> AsyncIterator[Callable[[], None]]:
        """Read one more body in a block.

        Yields
        ------
        callable
            To be called when some of the body has come.

        Raises
        ------
        Refused
            With the kind ``slow-body``, if nothing came of it for longest while so many others wait.
        """
        if len(self._bodies) >= BODIES:
            still, _ = self._bodies.popitem(last=False)
            still.reschedule(0.0)  # long ago
        try:
            async with asyncio.timeout(None) as body:
                self._bodies[body] = None
                try:
                    yield lambda: self._came(body)
                finally:
                    self._bodies.pop(body, None)
        except TimeoutError:
            raise Refused(Kind.SLOW_BODY, f"the body stood still while {BODIES} others of the vehicle came") from None

    def _came(self, body: asyncio.Timeout) -> None:
        if body in self._bodies:  # else it is given up already
            self._bodies.move_to_end(body)
