"""Events on their way to being lines: what takes long is done off the event loop, and before the transaction."""

from __future__ import annotations

import asyncio
import json
from collections import OrderedDict
from typing import NamedTuple

from robosac.audit import Unsealed, Writer, compact
from robosac.audit.events import Event, FrameAnswered


class Ready(NamedTuple):
    """A decision, ready to be kept."""

    said: Unsealed
    following: Writer
    state: str
    """What the defence remembers after it, as text."""


async def unsealed(event: Event) -> Unsealed:
    """An event as a record that only its place in the log is missing of."""
    return await asyncio.to_thread(lambda: Unsealed(compact(event)))


class Sealing:
    """Remembers what each session's log has said, so that the next decision need not repeat it.

    Parameters
    ----------
    full_every : int
        Frames from one record with the whole state to the next.
    remembered : int
        Sessions; the next record of any other is full.
    """

    def __init__(self, full_every: int, remembered: int) -> None:
        self._full_every = full_every
        self._remembered = remembered
        self._writers: OrderedDict[str, Writer] = OrderedDict()

    async def decision(self, session_id: str, event: FrameAnswered, follows: int | None) -> Ready:
        """As `unsealed`, and what to `follow` once it is kept; ``follows`` is the latest frame before.

        Until then nothing is remembered of the session: what may not be in the log must not be taken for said.
        """
        writer = self._writers.pop(session_id, None) or Writer(self._full_every)

        def work() -> Ready:
            record, following = writer.record(event, follows)
            return Ready(Unsealed(record), following, json.dumps(event.state))

        return await asyncio.to_thread(work)

    def follow(self, session_id: str, writer: Writer) -> None:
        """A decision is kept, and this knows it."""
        self._writers[session_id] = writer
        if len(self._writers) > self._remembered:
            self._writers.popitem(last=False)

    def forget(self, session_id: str) -> None:
        """A session is over."""
        self._writers.pop(session_id, None)
