"""Whose work is done next where many want one thread: fair shares first, and then who is due first."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

SLACK_S = 0.02
"""How much more than the others one may have had and still go first, if it is due first."""


CREDIT_S = 0.1
"""How far behind the others one may be that was away for a while: a claim to that much is kept, to more it is lost."""


class Waiting(Protocol):
    """Work that waits for its next turn."""

    @property
    def key(self) -> str:
        """The API key that it is done for."""

    @property
    def session_id(self) -> str:
        """The session that it is done for."""

    @property
    def due(self) -> float:
        """When it is due; seconds."""


W = TypeVar("W", bound=Waiting)


@dataclass
class _Shares:
    """Time that each of some parties had. Who comes back has little claim to time gone by, who is new has none."""

    had_s: dict[str, float] = field(default_factory=dict)

    def admit(self, party: str, others: Iterable[str]) -> None:
        """A party wants time that wanted none: it begins where the one of the others is that had least, or hardly
        before.
        """
        least = min((self.had_s[other] for other in others), default=0.0)
        self.had_s[party] = max(self.had_s.get(party, least), least - CREDIT_S)

    def entitled(self, parties: Iterable[str]) -> set[str]:
        """Those of the parties that had least, or not much more."""
        had = {party: self.had_s[party] for party in parties}
        most = min(had.values(), default=0.0) + SLACK_S
        return {party for party, seconds in had.items() if seconds <= most}

    def charge(self, party: str, seconds: float) -> None:
        """A party had its turn."""
        self.had_s[party] += seconds

    def forget(self, present: Iterable[str]) -> None:
        """Forget who wants nothing and would begin anew anyway. Without anybody present, all begin anew."""
        present = set(present)
        least = min((self.had_s[party] for party in present), default=math.inf)
        self.had_s = {party: s for party, s in self.had_s.items() if party in present or s > least - CREDIT_S}


class Turns(Generic[W]):
    """Pieces of work that take turns.

    1. A key may go next if it had no more time than any other key that wants some, but for `SLACK_S`.
    2. Of such a key a session may go next if it had no more than any other of the key's that wants some, likewise.
    3. Of the work of these sessions, what is due first goes next.

    Time that nobody else wanted is not held against anybody for longer than others have to catch up; and time that
    somebody did not want is not saved up. No lock is needed where one thread has the turns; `service.engine` holds one.
    """

    def __init__(self) -> None:
        self._jobs: list[W] = []
        self._keys = _Shares()
        self._sessions: dict[str, _Shares] = {}

    def __len__(self) -> int:
        return len(self._jobs)

    def add(self, job: W) -> None:
        """Let work take turns from now on."""
        keys, siblings = self._active()
        if job.key not in keys:
            self._keys.admit(job.key, keys)
        sessions = self._sessions.setdefault(job.key, _Shares())
        of_key = siblings.get(job.key, set())
        if job.session_id not in of_key:
            sessions.admit(job.session_id, of_key)
        self._jobs.append(job)

    def next(self) -> W:
        """The work whose turn it is.

        Raises
        ------
        IndexError
            If there is none.
        """
        keys, siblings = self._active()
        may = {
            (key, session)
            for key in self._keys.entitled(keys)
            for session in self._sessions[key].entitled(siblings[key])
        }
        entitled = [job for job in self._jobs if (job.key, job.session_id) in may]
        if not entitled:
            raise IndexError("nothing waits")
        return min(entitled, key=lambda job: job.due)

    def charge(self, job: W, seconds: float) -> None:
        """Work had its turn, which took so long."""
        self._keys.charge(job.key, seconds)
        self._sessions[job.key].charge(job.session_id, seconds)

    def remove(self, job: W) -> None:
        """Work is done, or wanted no more."""
        self._jobs.remove(job)
        keys, siblings = self._active()
        self._keys.forget(keys)
        for key in list(self._sessions):
            if key in self._keys.had_s:
                self._sessions[key].forget(siblings.get(key, ()))
            else:
                del self._sessions[key]

    def _active(self) -> tuple[set[str], dict[str, set[str]]]:
        """Keys that want time, and the sessions of each that do."""
        siblings: dict[str, set[str]] = {}
        for job in self._jobs:
            siblings.setdefault(job.key, set()).add(job.session_id)
        return set(siblings), siblings
