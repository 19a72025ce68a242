"""A log, and what else is long, as it is sent: a little at a time."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import AsyncIterator
from itertools import accumulate

from service.errors import SessionOver, StoreUnavailable
from service.keeping.store import PAGE, Store

logger = logging.getLogger(__name__)

FIRST_PAGE = 4
"""Lines of a log that are read first; then at most twice as many as were sent before."""
PAGE_BYTES = 2**18
"""What is sent at a time, or one line of a log: whoever stops to read it makes the gateway hold no more."""


async def pages(store: Store, session_id: str, after: int, last: int) -> AsyncIterator[str]:
    """The lines of a session's log with the numbers after ``after``, up to ``last``.

    Raises
    ------
    SessionOver
        If the log is purged meanwhile.
    StoreUnavailable
        If lines of it are missing.
    """
    page = FIRST_PAGE
    while after < last:
        page = min(page, last - after)
        lines = await store.audit(session_id, after, page)
        if len(lines) < page:  # what was sent must not look whole
            record = await store.get(session_id)
            if record is None or record.purging:  # from its beginning on
                raise SessionOver("the log was purged")
            logger.error("the database failed: the log of session %s is damaged after record %d", session_id, after)
            raise StoreUnavailable
        fitting = max(1, bisect_right(list(accumulate(map(len, lines))), PAGE_BYTES))
        after, page = after + fitting, min(PAGE, 2 * fitting)
        yield "\n".join(lines[:fitting]) + "\n"


async def pieces(body: bytes) -> AsyncIterator[bytes]:
    """A body that is at hand as a whole."""
    for start in range(0, len(body), PAGE_BYTES):
        yield body[start : start + PAGE_BYTES]


async def begun(pages: AsyncIterator[str]) -> AsyncIterator[str]:
    """The same pages, of which the first is read already: what fails at once can still be told."""
    return _after(await anext(pages, ""), pages)


async def _after(first: str, others: AsyncIterator[str]) -> AsyncIterator[str]:
    if first:
        yield first
    async for page in others:
        yield page
