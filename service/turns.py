"""Whose work is done next where many want one thread: fair shares first, and then who is due first."""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from operator import itemgetter

SLACK_S = 0.02
"""How much more than the others one may have at the end of its work and still go first, if it is due first."""
CREDIT_S = 0.1
"""How far behind the others one may be that was away for a while: a claim to that much is kept, to more it is lost."""
KNOWN = 4096
"""Parties that are remembered while they want nothing."""
LEAST_S, MOST_S = 0.002, 0.5
"""What work is taken to want yet, however little or much is expected. So long it may hold up those who had as much."""
LAST_STEPS = 3
"""Steps before work is due from which on it goes first, if it was begun; and as many after, no more."""


@dataclass(eq=False)
class Work:
    """A piece of work for a session of an API key. It is done in steps."""

    key: str
    session_id: str
    due: float
    """When it has to be over; seconds of `time.perf_counter`."""
    expected_s: float
    """The time that it is expected to want."""
    had_s: float = 0.0
    """The time that it had."""
    longest_step_s: float = field(default=0.0, repr=False)
    over: bool = False

    @property
    def left_s(self) -> float:
        """What it is taken to want yet."""
        return min(max(self.expected_s - self.had_s, LEAST_S), MOST_S)

    def is_urgent(self, now: float) -> bool:
        """Whether it was begun, and must have its turn now to be over in time, or hardly late."""
        return self.had_s > 0 and abs(self.due - now) < LAST_STEPS * self.longest_step_s

    def charge(self, seconds: float) -> None:
        """It had a step."""
        self.had_s += seconds
        self.longest_step_s = max(self.longest_step_s, seconds)


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
        if party in self._present:
            return self._had_s[party]
        self._raise_floor()
        return max(self._had_s.get(party, self._floor_s), self._floor_s - CREDIT_S)

    def charge(self, party: str, seconds: float) -> None:
        """A party had so much more; it may have left meanwhile."""
        self._had_s[party] = self._had_s.get(party, self._floor_s) + seconds

    def _raise_floor(self) -> None:
        self._floor_s = max(self._floor_s, min((self._had_s[party] for party in self._present), default=0.0))


class Turns:
    """Pieces of work that take turns, step by step.

    1. A key may go next if it will have had less than any other once a piece of its work is over, as in fair queueing,
       but for `SLACK_S`. So work that was begun is not put off for that of equals.
    2. Of such a key a session may go next by the same rule.
    3. Of the work of these sessions, what is due first goes next.
    4. Work that was begun, and is about to be due, goes before all others: it ends then with what it has.

    Time that nobody else wanted is not held against anybody for longer than others have to catch up. Of time that
    somebody did not want, no more than `CREDIT_S` is saved up: so who wants little goes first among those who always
    want more. No lock is needed where one thread has the turns; `service.engine` holds one.

    Work that is done elsewhere, on other threads, has its part in the same shares (`join`, `put_down`, `leave`).
    """

    def __init__(self) -> None:
        self._works: list[Work] = []
        self._keys = _Shares()
        self._sessions: OrderedDict[str, _Shares] = OrderedDict()
        self.charged_s = 0.0
        """Time that all had."""

    def __len__(self) -> int:
        return len(self._works)

    def add(self, work: Work) -> None:
        """Let work take turns from now on."""
        self._works.append(work)
        self.join(work)

    def join(self, work: Work) -> None:
        """Let work that is done elsewhere have its part in the shares."""
        self._keys.join(work.key)
        self._sessions.setdefault(work.key, _Shares()).join(work.session_id)
        self._sessions.move_to_end(work.key)

    def next(self, now: float, waiting: Collection[Work] = ()) -> Work:
        """The work whose turn it is, of that which does not wait for other work.

        Raises
        ------
        IndexError
            If there is none.
        """
        if not self._works:
            raise IndexError("nothing waits")
        if len(self._works) == 1:
            return self._works[0]
        works = [work for work in self._works if work not in waiting] if waiting else self._works
        by_key = self._by_key(works)
        claims = {key: self._keys.had(key) + of_key[0][1].left_s for key, of_key in by_key.items()}
        most_s = min(claims.values()) + SLACK_S
        first = [
            work
            for key, of_key in by_key.items()
            if claims[key] <= most_s
            for claim_s, work in of_key
            if claim_s <= of_key[0][0] + SLACK_S
        ]
        return min([work for work in works if work.is_urgent(now)] or first, key=lambda work: work.due)

    def order(self, works: Iterable[Work]) -> list[Work]:
        """Work in the order in which it would be over if no other came, as far as claims tell.

        Its sessions are no longer new then: if work is refused for the sake of others, what they have meanwhile counts
        for it.
        """
        works = list(works)
        for work in works:
            self._keys.know(work.key)
            self._sessions.setdefault(work.key, _Shares()).know(work.session_id)
            self._sessions.move_to_end(work.key)
        self._forget()
        claims = []
        for key, of_key in self._by_key(works).items():
            claim_s = self._keys.had(key)
            for _, work in of_key:
                claim_s += work.left_s
                claims.append((claim_s, work))
        return [work for _, work in sorted(claims, key=itemgetter(0))]

    def charge(self, work: Work, seconds: float) -> None:
        """Work had its turn, which took so long."""
        work.charge(seconds)
        self.charged_s += seconds
        self.put_down(work, seconds)

    def put_down(self, work: Work, seconds: float) -> None:
        """Work that is done elsewhere took so long; it may have left meanwhile."""
        self._keys.charge(work.key, seconds)
        if work.key in self._sessions:
            self._sessions[work.key].charge(work.session_id, seconds)

    def remove(self, work: Work) -> None:
        """Work is done, or wanted no more."""
        self._works.remove(work)
        self.leave(work)

    def leave(self, work: Work) -> None:
        """Work that is done elsewhere is done, or wanted no more."""
        self._keys.leave(work.key)
        self._sessions[work.key].leave(work.session_id)
        self._forget()

    def lead(self, work: Work, other: Work) -> float:
        """How much less one had than the other until now; seconds, negative where it had more.

        Between keys the keys' shares count, within a key those of its sessions.
        """
        if work.key != other.key:
            return self._keys.had(other.key) - self._keys.had(work.key)
        return self._had_of_key(other) - self._had_of_key(work)

    def first(self, works: Iterable[Work]) -> Work:
        """Of work that is done elsewhere, that of the key that had least; of a key's, that of the session that had."""
        return min(works, key=lambda work: (self._keys.had(work.key), self._had_of_key(work)))

    def puts_off(self, work: Work) -> bool:
        """Whether work that has turns here goes before some that is done elsewhere: it will still have had less than
        that once it is over.
        """
        return any(self.lead(here, work) > here.left_s for here in self._works)

    def _had_of_key(self, work: Work) -> float:
        return self._sessions.setdefault(work.key, _Shares()).had(work.session_id)

    def _by_key(self, works: Iterable[Work]) -> dict[str, list[tuple[float, Work]]]:
        """Work of each key, and what its session will have had once it is over, by which it is sorted."""
        by_key: defaultdict[str, list[tuple[float, Work]]] = defaultdict(list)
        for work in works:
            by_key[work.key].append((self._sessions[work.key].had(work.session_id) + work.left_s, work))
        for of_key in by_key.values():
            of_key.sort(key=itemgetter(0))
        return by_key

    def _forget(self) -> None:
        while len(self._sessions) - len(self._keys) > KNOWN:
            del self._sessions[next(key for key, sessions in self._sessions.items() if not sessions)]
