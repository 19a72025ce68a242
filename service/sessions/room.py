"""Bytes that all may hold together, so that nobody takes what the others need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from service.errors import Kind, Refused


class Room:
    """Counts who holds how many bytes.

    All together may hold ``limit``, and the sessions of one key ``of_key``. A session that holds some already may not
    hold more than is left for all others: so however many are greedy, the next one finds room.

    Parameters
    ----------
    limit : int
        Bytes.
    of_key : int, optional
        By default no less than all.
    name : str
        The settings that say so, as a refusal names them: with ``_PER_KEY`` for that of one key.
    """

    def __init__(self, limit: int, of_key: int | None = None, name: str = "") -> None:
        self.limit = limit
        self.nbytes = 0
        self._of_key = limit if of_key is None else of_key
        self._name = name
        self._keys: Counter[str] = Counter()
        self._sessions: Counter[str] = Counter()

    def share(self, key: str, session_id: str) -> Share:
        """That of one session."""
        return Share(self, key, session_id)

    def check(self, key: str, session_id: str, nbytes: int) -> None:
        """Refuse what there is no room for.

        Raises
        ------
        Refused
            With the kind ``overloaded``.
        """
        left, mine = self.limit - self.nbytes - nbytes, self._sessions[session_id]
        if self._keys[key] + nbytes > self._of_key:
            cap = f"{self._name}_PER_KEY" if self._name else "an API key"
            raise Refused(Kind.OVERLOADED, f"{cap} allows {self._of_key} bytes of one key at a time")
        if left < 0 or (mine and mine + nbytes > left):
            said = f"{self._name or 'all together'} allows {self.limit} bytes, and each session what is left for others"
            raise Refused(Kind.OVERLOADED, said)

    def add(self, key: str, session_id: str, nbytes: int) -> None:
        """Count bytes that a session holds from now on, or no longer (less than 0)."""
        self.nbytes += nbytes
        for held, who in ((self._keys, key), (self._sessions, session_id)):
            held[who] += nbytes
            if not held[who]:
                del held[who]


@dataclass(frozen=True)
class Share:
    """What one session holds of the room of all."""

    room: Room
    key: str
    session_id: str

    def check(self, nbytes: int) -> None:
        """As `Room.check`."""
        self.room.check(self.key, self.session_id, nbytes)

    def add(self, nbytes: int) -> None:
        """As `Room.add`."""
        self.room.add(self.key, self.session_id, nbytes)

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
