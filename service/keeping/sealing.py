"""Events on their way to being lines: what takes long is done off the event loop, and before the transaction."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from robosac.audit import Unsealed, Writer, compact
from robosac.audit.events import Event, FrameAnswered


@dataclass(frozen=True)
class Ready:
    """An event, ready to be kept."""

    said: Unsealed
    state: str | None = None
    """What the defence remembers after a decision, as text."""


@dataclass(frozen=True)
class ReadyDecision(Ready):
    """A decision, ready to be kept."""

    following: Writer = field(kw_only=True)
    """Knows what its session's log has said then."""


T_co = TypeVar("T_co", covariant=True)


class Draft(Generic[T_co]):
    """Something that is made on the thread on which it is needed, just before its transaction."""

    def __init__(self, make: Callable[[], T_co]) -> None:
        self._make = make

    def write(self) -> None:
        """Make it."""
        self._made = self._make()

    @property
    def made(self) -> T_co:
        """What was made."""
        return self._made


def sealed(event: Event, session_id: str, seq: int, head: str) -> str:
    """An event as the line that is its place in the log."""
    return Unsealed(compact(event)).seal(session_id, seq, head)


def drafted(event: Event) -> Draft[Ready]:
    """An event as a record that only its place in the log is missing of."""
    return Draft(lambda: Ready(Unsealed(compact(event))))


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

    def decision(self, session_id: str, event: FrameAnswered, follows: int | None) -> Draft[ReadyDecision]:
        """As `drafted`, and what to `follow` once it is kept; ``follows`` is the latest frame before.

        Until then nothing is remembered of the session: what may not be in the log must not be taken for said.
        """
        writer = self._writers.pop(session_id, None) or Writer(self._full_every)

        def work() -> ReadyDecision:
            record, state, following = writer.record(event, follows)
            return ReadyDecision(Unsealed(record), state, following=following)

        return Draft(work)

    def follow(self, session_id: str, writer: Writer) -> None:
        """A decision is kept, and this knows it."""
        self._writers[session_id] = writer
        if len(self._writers) > self._remembered:
            self._writers.popitem(last=False)

    def forget(self, session_id: str) -> None:
        """A session is over."""
        self._writers.pop(session_id, None)
