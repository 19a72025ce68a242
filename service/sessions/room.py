"""Bytes that all may hold together, so that nobody takes what the others need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from service.errors import Kind, Refused


class Room:
    """Counts who holds how many bytes.

    All together may hold ``limit``. No API key may hold more than is left for the others, no session more than is left
    for the others of its key, and no vehicle more than is left for the others of its session: so however many are
    greedy, the next one finds room. Who holds nothing yet may take as much as its key has left, so that no teammate
    keeps its ego's frame out.

    Parameters
    ----------
    limit : int
        Bytes.
    of_key : int, optional
        Bytes of one key, where there are several. Otherwise one has all to itself.
    name : str
        The settings that say so, as a refusal names them: with ``_PER_KEY`` for that of one key.
    """

    def __init__(self, limit: int, of_key: int | None = None, name: str = "") -> None:
        self.limit = limit
        self.nbytes = 0
        self._of_key = of_key
        self._name = name
        self._held: Counter[tuple[str, ...]] = Counter()

    def share(self, *who: str) -> Share:
        """That of a key, of one of its sessions, or of a vehicle of that."""
        return Share(self, who)

    def check(self, who: tuple[str, ...], nbytes: int, before: int = 0) -> None:
        """Refuse what there is no room for; ``before`` are bytes that are held already for the same purpose.

        Raises
        ------
        Refused
            With the kind ``overloaded``.
        """
        if self._of_key is not None and self._held[who[:1]] + nbytes > self._of_key:
            cap = f"{self._name}_PER_KEY" if self._name else "an API key"
            raise Refused(Kind.OVERLOADED, f"{cap} allows {self._of_key} bytes of one key at a time")
        levels = [who[:depth] for depth in range(1, len(who) + 1)]
        if self._held[who] == before:
            levels = levels[:1]
        if self._of_key is None:
            levels = levels[1:]
        left = self.limit - self.nbytes
        for level in levels:
            held = self._held[level]
            left = left if held == before else (left - held) // 2  # as much is left for others then as it holds
        if nbytes > left:
            said = f"{self._name or 'all together'} allows {self.limit} bytes"
            detail = f"{said}, and each API key, session and vehicle no more than is left for others"
            raise Refused(Kind.OVERLOADED, detail)

    def add(self, who: tuple[str, ...], nbytes: int) -> None:
        """Count bytes that somebody holds from now on, or no longer (less than 0)."""
        self.nbytes += nbytes
        for depth in range(1, len(who) + 1):
            level = who[:depth]
            self._held[level] += nbytes
            if not self._held[level]:
                del self._held[level]


@dataclass
class Share:
    """What one request holds of the room of all, or whatever else holds some for one purpose."""

    room: Room
    who: tuple[str, ...]
    nbytes: int = field(default=0, init=False)

    def of(self, name: str) -> Share:
        """That of one of those who share this one."""
        return Share(self.room, (*self.who, name))

    def check(self, nbytes: int) -> None:
        """As `Room.check`."""
        self.room.check(self.who, nbytes, self.nbytes)

    def add(self, nbytes: int) -> None:
        """As `Room.add`."""
        self.nbytes += nbytes
        self.room.add(self.who, nbytes)

    @contextmanager
    def holding(self, nbytes: int) -> Iterator[None]:
        """Hold bytes for the length of a block, if there is room; for none there always is."""
        if nbytes:
            self.check(nbytes)
        self.add(nbytes)
        try:
            yield
        finally:
            self.add(-nbytes)
