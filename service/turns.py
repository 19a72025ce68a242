"""Whose work is done next where many want one thread: fair shares first, and then who is due first."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import Generic, Protocol, TypeVar

SLACK_S = 0.02
"""How much more than the others one may have had and still go first, if it is due first."""


CREDIT_S = 0.1
"""How far behind the others one may be that was away for a while: a claim to that much is kept, to more it is lost."""


KNOWN = 4096
"""Parties that are remembered while they want nothing."""


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


class _Shares:
    """Time that each of some parties had. Who comes back has little claim to time gone by, who is new has none."""

    def __init__(self) -> None:
        self._had_s: OrderedDict[str, float] = OrderedDict()
        self._present: Counter[str] = Counter()
        self._floor_s = 0.0
        """The least that anybody had who was there; it never falls, so that all keep their places while nobody is."""

    def __len__(self) -> int:
        return len(self._present)

    def join(self, party: str) -> None:
        """A party wants time for one more piece of work."""
        if party not in self._present:
            self.know(party)
        self._present[party] += 1

    def know(self, party: str) -> float:
        """What a party had, who is no longer new then."""
        self._had_s[party] = self.had(party)
        self._had_s.move_to_end(party)
        self._forget()
        return self._had_s[party]

    def leave(self, party: str) -> None:
        """A piece of work of a party wants no more time."""
        self._raise_floor()
        self._present[party] -= 1
        if not self._present[party]:
            del self._present[party]
        self._forget()

    def _forget(self) -> None:
        while len(self._had_s) - len(self._present) > KNOWN:
            del self._had_s[next(party for party in self._had_s if party not in self._present)]

    def had(self, party: str) -> float:
        """What a party had, as it counts beside the others."""
        self._raise_floor()
        return max(self._had_s.get(party, self._floor_s), self._floor_s - CREDIT_S)

    def entitled(self) -> set[str]:
        """Those present that had least, or not much more."""
        most = min((self._had_s[party] for party in self._present), default=0.0) + SLACK_S
        return {party for party in self._present if self._had_s[party] <= most}

    def charge(self, party: str, seconds: float) -> None:
        """A party had its turn."""
        self._had_s[party] += seconds

    def _raise_floor(self) -> None:
        self._floor_s = max(self._floor_s, min((self._had_s[party] for party in self._present), default=0.0))


class Turns(Generic[W]):
    """Pieces of work that take turns.

    1. A key may go next if it had no more time than any other key that wants some, but for `SLACK_S`.
    2. Of such a key a session may go next if it had no more than any other of the key's that wants some, likewise.
    3. Of the work of these sessions, what is due first goes next.

    Time that nobody else wanted is not held against anybody for longer than others have to catch up. Of time that
    somebody did not want, no more than `CREDIT_S` is saved up: so who wants little goes first among those who always
    want more. No lock is needed where one thread has the turns; `service.engine` holds one.
    """

    def __init__(self) -> None:
        self._jobs: list[W] = []
        self._keys = _Shares()
        self._sessions: OrderedDict[str, _Shares] = OrderedDict()

    def __len__(self) -> int:
        return len(self._jobs)

    def add(self, job: W) -> None:
        """Let work take turns from now on."""
        self._jobs.append(job)
        self._keys.join(job.key)
        self._sessions.setdefault(job.key, _Shares()).join(job.session_id)
        self._sessions.move_to_end(job.key)

    def next(self) -> W:
        """The work whose turn it is.

        Raises
        ------
        IndexError
            If there is none.
        """
        if not self._jobs:
            raise IndexError("nothing waits")
        if len(self._jobs) == 1:
            return self._jobs[0]
        may = {key: self._sessions[key].entitled() for key in self._keys.entitled()}
        return min((job for job in self._jobs if job.session_id in may.get(job.key, ())), key=lambda job: job.due)

    def charge(self, job: W, seconds: float) -> None:
        """Work had its turn, which took so long."""
        self._keys.charge(job.key, seconds)
        self._sessions[job.key].charge(job.session_id, seconds)

    def remove(self, job: W) -> None:
        """Work is done, or wanted no more."""
        self._jobs.remove(job)
        self._keys.leave(job.key)
        self._sessions[job.key].leave(job.session_id)
        self._forget()

    def lead(self, key: str, session_id: str, other_key: str, other_session: str) -> float:
        """For how long work of a session goes before that of another, as one of them had less than the other until now;
        seconds, negative where it goes after.

        Between keys the keys' shares count, within a key those of its sessions. The session is no longer new then: if
        its work is refused for the sake of others, what they have meanwhile counts for it.
        """
        if key != other_key:
            return self._keys.had(other_key) - self._keys.know(key)
        sessions = self._sessions.setdefault(key, _Shares())
        return sessions.had(other_session) - sessions.know(session_id)

    def _forget(self) -> None:
        while len(self._sessions) - len(self._keys) > KNOWN:
            del self._sessions[next(key for key, sessions in self._sessions.items() if not sessions)]
