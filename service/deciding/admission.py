"""How many frames are taken on at a time: no more than can be answered within their budgets."""

from __future__ import annotations

import math
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import chain

from robosac.deadline import Deadline
from service.errors import Kind, Refused
from service.turns import SLACK_S

SHARE = 0.5
"""Part of a frame's time, beyond what it needs itself, that others' work may take; and the most that is kept for
storing its decision.
"""
SESSION_FRAMES = 3
"""Frames of one session in hand or waiting at a time."""
FIRST_GUESS_S = 0.02
LATEST = 9
"""Measurements of which the median counts, so that one stall, or four, teach nothing."""
SESSIONS_KNOWN = 4096


class Typical:
    """The median of the latest measurements."""

    def __init__(self, first: float) -> None:
        self._latest = deque([first], LATEST)
        self.value = first

    def learn(self, measured: float) -> None:
        """Take a measurement into account."""
        self._latest.append(measured)
        self.value = sorted(self._latest)[(len(self._latest) - 1) // 2]


class Admission:
    """Counts the frames in hand and estimates from the latest what those of each session cost.

    The detector's thread is shared fairly between API keys, and between the sessions of a key (`service.engine`). So
    until a frame is done, every other session of its key is given at most as much time as its own, and every other key
    at most as much as its own; less where they had more than it until now, and more where they had less. Of what the
    others want no more than that counts. A frame is admitted if all this is expected to fit into `SHARE` of the time
    that it can spare: what it has left, less its own time on the thread, less the rest that a frame takes, such as
    storing it. One that nobody holds up is admitted. A frame that waits for its teammates is not in hand.

    Parameters
    ----------
    max_hypotheses : int
        Of one frame.
    lead : callable
        As `service.turns.Turns.lead`.
    """

    def __init__(
        self, max_hypotheses: int = 1000, lead: Callable[[str, str, str, str], float] = lambda *_: 0.0
    ) -> None:
        self._max_hypotheses = max_hypotheses
        self._lead = lead
        self._in_hand: dict[str, dict[str, list[float]]] = {}
        """When the frames are due (`time.perf_counter`), by key and session."""
        self._waiting: Counter[str] = Counter()
        self._store, self._rest = Typical(0.0), Typical(0.0)
        self._frame = Typical(FIRST_GUESS_S)
        self._of_session: OrderedDict[str, Typical] = OrderedDict()

    def check(self, key: str, session_id: str, left_s: float) -> None:
        """Refuse a frame that is not expected to be answered in the time that it has left.

        Raises
        ------
        Refused
            With the kind ``overloaded``.
        """
        self.check_waiting(session_id)
        self._check_time(key, session_id, left_s)

    def check_waiting(self, session_id: str) -> None:
        """Refuse a frame of a session of which enough wait, as `check` does."""
        if self._waiting[session_id] >= SESSION_FRAMES:
            raise _overloaded(f"{SESSION_FRAMES} frames of this session are in hand", self._cost(session_id))

    @contextmanager
    def waiting(self, session_id: str) -> Iterator[None]:
        """Let a frame wait for its turn in its session and for its teammates, for the length of a block.

        The block lasts until the frame is answered. It costs the others nothing.
        """
        self.check_waiting(session_id)
        self._waiting[session_id] += 1
        try:
            yield
        finally:
            self._waiting[session_id] -= 1
            if not self._waiting[session_id]:
                del self._waiting[session_id]

    @contextmanager
    def frame(self, key: str, session_id: str, left_s: float) -> Iterator[None]:
        """Take a frame on for the length of a block, or refuse it as too late among those in hand."""
        self._check_time(key, session_id, left_s)
        due = time.perf_counter() + left_s
        sessions = self._in_hand.setdefault(key, {})
        sessions.setdefault(session_id, []).append(due)
        try:
            yield
        finally:
            sessions[session_id].remove(due)
            if not sessions[session_id]:
                del sessions[session_id]
            if not sessions:
                del self._in_hand[key]

    def deadline(self, due: float, budget_s: float) -> Deadline:
        """The deadline of a frame that is due then (`time.perf_counter`); time to keep its decision is reserved."""
        return Deadline(due, min(self._store.value, SHARE * budget_s), hypotheses=self._max_hypotheses)

    def learn(self, session_id: str, worked_s: float, rest_s: float, store_s: float) -> None:
        """Take a frame into account.

        Parameters
        ----------
        session_id : str
        worked_s : float
            Its time on the detector's thread.
        rest_s : float
            What it took besides, other than to wait for its turns there and for its teammates.
        store_s : float
            Of that, what keeping its decision took.
        """
        self._frame.learn(worked_s)
        self._rest.learn(rest_s)
        self._store.learn(store_s)
        if session_id not in self._of_session:
            self._of_session[session_id] = Typical(self._frame.value)
        self._of_session[session_id].learn(worked_s)
        self._of_session.move_to_end(session_id)
        if len(self._of_session) > SESSIONS_KNOWN:
            self._of_session.popitem(last=False)

    def _cost(self, session_id: str) -> float:
        return self._of_session.get(session_id, self._frame).value

    def _check_time(self, key: str, session_id: str, left_s: float) -> None:
        own_s, others_s = self._cost(session_id), self._others(key, session_id, time.perf_counter() + left_s)
        if others_s > max(0.0, SHARE * (left_s - own_s - self._rest.value)):
            raise _overloaded("the gateway has more frames in hand than it can answer in time", others_s)

    def _others(self, key: str, session_id: str, due: float) -> float:
        """How long the thread is expected to work for others until one more frame of a session is done.

        Those that are due later go first only once this one has had `SLACK_S` more than they.
        """

        def before(wanted_s: float, dues: Iterable[float], own_s: float, lead_s: float) -> float:
            return max(0.0, min(wanted_s, own_s - lead_s) - (SLACK_S if min(dues) > due else 0.0))

        def wanted(session: str, dues: list[float]) -> float:
            return len(dues) * self._cost(session)

        cost_s, siblings = self._cost(session_id), self._in_hand.get(key, {})
        own_s = cost_s + wanted(session_id, siblings.get(session_id, []))
        of_key_s = own_s + sum(
            before(wanted(other, dues), dues, own_s, self._lead(key, session_id, key, other))
            for other, dues in siblings.items()
            if other != session_id
        )
        other_keys_s = sum(
            before(
                sum(wanted(s, d) for s, d in sessions.items()),
                chain(*sessions.values()),
                of_key_s,
                self._lead(key, session_id, other, ""),
            )
            for other, sessions in self._in_hand.items()
            if other != key
        )
        return of_key_s - cost_s + other_keys_s


def _overloaded(detail: str, busy_s: float) -> Refused:
    return Refused(Kind.OVERLOADED, detail, retry_after_s=max(1, math.ceil(busy_s)))
