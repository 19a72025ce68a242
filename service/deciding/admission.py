"""How many frames are taken on at a time: no more than can be answered within their budgets."""

from __future__ import annotations

import math
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import takewhile
from typing import Protocol

from robosac.deadline import Deadline
from service.errors import Kind, Refused
from service.turns import Turns, Work

SHARE = 0.5
"""Part of a frame's time, beyond what it needs itself, that others' work may take; and the most that is kept for
storing its decision.
"""
MARGIN_S = 0.08
"""By how much less a party must have had than another to make its frames late; less than what a party saves up that was
away (`service.turns.CREDIT_S`), more than what equals differ by.
"""
SESSION_FRAMES = 3
"""Frames of one session in hand or waiting at a time."""
KEY_FRAMES = 32
"""Those of one of several API keys, that are to be read included. More keep the thread no busier, and to find out whose
turn it is takes all the longer.
"""
COMING_S = 0.05
"""For how long a frame that is to be read counts as if it were in hand: its link holds up one that takes longer."""
DOUBT_S = 10.0
"""For how long frames of a session do not count so, after one that did not come."""
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


class Needs:
    """What the frames of a session need, seconds: on the detector's thread, and besides."""

    def __init__(self, work_s: float, rest_s: float) -> None:
        self.work, self.rest = Typical(work_s), Typical(rest_s)


class Ordering(Protocol):
    """Who goes before whom, as `service.turns.Turns` has it."""

    def order(self, works: Iterable[Work]) -> list[Work]:
        """As `service.turns.Turns.order`."""

    def lead(self, work: Work, other: Work) -> float:
        """As `service.turns.Turns.lead`."""


class Admission:
    """Knows the frames in hand and estimates from the latest what those of each session cost.

    The detector's thread is shared fairly between API keys, and between the sessions of a key (`service.turns`). A
    frame is admitted if those that go before it there are expected to fit into `SHARE` of the time that it can spare:
    what it has left, less its own time on the thread, less the rest that a frame takes, such as storing it. One that
    nobody holds up is admitted. But it is refused if one in hand would be late for it, unless its party had less than
    the other's by more than `MARGIN_S`. A frame that waits for its teammates is not in hand.

    Parameters
    ----------
    max_hypotheses : int
        Of one frame.
    turns : Ordering, optional
        Those of the thread.
    key_frames : int, optional
        The most of one key, where there are several; one has all to itself.
    """

    def __init__(
        self, max_hypotheses: int = 1000, turns: Ordering | None = None, key_frames: int | None = None
    ) -> None:
        self._max_hypotheses = max_hypotheses
        self._key_frames = key_frames
        self._turns = Turns() if turns is None else turns
        self._in_hand: set[Work] = set()
        self._waiting: Counter[str] = Counter()
        self._expected: OrderedDict[tuple[str, str], float] = OrderedDict()
        """Until when."""
        self._coming: dict[str, tuple[float, Work]] = {}
        """By session, with when it was let in."""
        self._doubted: OrderedDict[str, float] = OrderedDict()
        """Until when."""
        self._store, self._frame = Typical(0.0), Typical(FIRST_GUESS_S)
        self._of_session: OrderedDict[str, Needs] = OrderedDict()

    @property
    def busy(self) -> bool:
        """Whether frames are in hand."""
        return bool(self._in_hand)

    def wanted_by(self) -> Iterator[tuple[str, str]]:
        """The keys and ids of sessions whose frames are in hand, or are expected; some more than once."""
        now = time.perf_counter()
        yield from ((work.key, work.session_id) for work in self._in_hand)
        yield from (session for session, until in self._expected.items() if until > now)

    def expect(self, key: str, session_id: str) -> None:
        """Something of a vehicle of this session begins to come, or is to be read, which a frame needs."""
        now, session = time.perf_counter(), (key, session_id)
        self._expected[session] = now + COMING_S
        self._expected.move_to_end(session)
        while self._expected[first := next(iter(self._expected))] < now:
            del self._expected[first]

    def check(self, key: str, session_id: str, due: float) -> None:
        """Refuse a whole frame, of which nothing is read yet, that is not expected to be answered in time.

        Raises
        ------
        Refused
            With the kind ``overloaded``.
        """
        self.check_waiting(session_id)
        self._check_time(self._work(key, session_id, due), due, self._to_come(key))

    @contextmanager
    def coming(self, key: str, session_id: str, due: float) -> Iterator[Work]:
        """Let a whole frame be read for the length of a block, or refuse it as `check` does. Once it is there, its work
        is to be marked as over.
        """
        self.check(key, session_id, due)
        began, work = time.perf_counter(), self._work(key, session_id, due)
        if session_id in self._coming or began < self._doubted.get(session_id, began):
            yield work
            return
        self._coming[session_id] = began, work
        try:
            yield work
        except Refused as refused:
            work.over = work.over or refused.kind is Kind.OVERLOADED
            raise
        finally:
            del self._coming[session_id]
            if not work.over:
                self._doubt(session_id)

    def _doubt(self, session_id: str) -> None:
        self._doubted[session_id] = time.perf_counter() + DOUBT_S
        self._doubted.move_to_end(session_id)
        if len(self._doubted) > SESSIONS_KNOWN:
            self._doubted.popitem(last=False)

    def _to_come(self, key: str) -> list[Work]:
        since = time.perf_counter() - COMING_S
        lately = takewhile(lambda came: came[0] > since, reversed(self._coming.values()))
        return [work for _, work in lately if work.key == key]

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
    def frame(self, key: str, session_id: str, due: float, budget_s: float) -> Iterator[Work]:
        """Take a frame on for the length of a block, or refuse it as too late among those in hand.

        Parameters
        ----------
        key, session_id : str
        due : float
            When its answer is (`time.perf_counter`); time to keep the decision is reserved in the work's.
        budget_s : float

        Yields
        ------
        Work
            Of the detector's thread.
        """
        work = self._work(key, session_id, due - min(self._store.value, SHARE * budget_s))
        self._check_time(work, due)
        self._in_hand.add(work)
        try:
            yield work
        finally:
            self._in_hand.remove(work)

    def deadline(self, work: Work) -> Deadline:
        """The deadline of a frame's work."""
        return Deadline(work.due, hypotheses=self._max_hypotheses)

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
        self._store.learn(store_s)
        if session_id not in self._of_session:
            self._of_session[session_id] = self._needs(session_id)
        needs = self._of_session[session_id]
        needs.work.learn(worked_s)
        needs.rest.learn(rest_s)
        self._of_session.move_to_end(session_id)
        if len(self._of_session) > SESSIONS_KNOWN:
            self._of_session.popitem(last=False)

    def _needs(self, session_id: str) -> Needs:
        """What a session's frames need; of one that is not known, what others need, but for how slowly they send."""
        return self._of_session.get(session_id) or Needs(self._frame.value, self._store.value)

    def _cost(self, session_id: str) -> float:
        return self._needs(session_id).work.value

    def _work(self, key: str, session_id: str, due: float) -> Work:
        return Work(key, session_id, due, self._cost(session_id))

    def _check_time(self, new: Work, due: float, to_come: Iterable[Work] = ()) -> None:
        works = [work for work in (*self._in_hand, *to_come) if not work.over]
        if self._key_frames is not None and sum(work.key == new.key for work in works) >= self._key_frames:
            raise _overloaded(f"{self._key_frames} frames of this API key are in hand", new.expected_s)
        now, others_s, is_after = time.perf_counter(), 0.0, False
        end = now
        for work in self._turns.order([*works, new]):
            if work is new:
                is_after = True
            elif not is_after:
                others_s += work.left_s
                end += work.left_s
            else:
                end += work.left_s
                if end <= work.due < end + new.expected_s and self._turns.lead(new, work) < MARGIN_S:
                    raise _overloaded("frames in hand would be answered late for it", end - now)
        if others_s > max(0.0, SHARE * (due - now - new.expected_s - self._needs(new.session_id).rest.value)):
            raise _overloaded("the gateway has more frames in hand than it can answer in time", others_s)


def _overloaded(detail: str, busy_s: float) -> Refused:
    return Refused(Kind.OVERLOADED, detail, retry_after_s=max(1, math.ceil(busy_s)))
