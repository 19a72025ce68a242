"""When an answer is due, and what still fits before it: what fusion knows of time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from numbers import Integral, Real

SAFETY = 1.2
"""A pass is begun only if this multiple of the dearest one so far still fits."""


class Deadline:
    """The end of a frame's time, and what its passes cost so far.

    Parameters
    ----------
    at : float
        When the answer is due, in the clock's time; infinite by default.
    reserve_s : float
        What has to be left for whatever comes after the fusion.
    hypotheses : int, optional
        How many may be tested, however much time there is.
    clock : callable
        Monotonic, seconds.

    Raises
    ------
    TypeError, ValueError
        If ``at`` is no time, ``reserve_s`` is no finite number from 0 on, or ``hypotheses`` no whole number from 0 on.
    """

    def __init__(
        self,
        at: float = math.inf,
        reserve_s: float = 0.0,
        clock: Callable[[], float] = time.perf_counter,
        hypotheses: int | None = None,
    ) -> None:
        for name, seconds in (("at", at), ("reserve_s", reserve_s)):
            if isinstance(seconds, bool) or not isinstance(seconds, Real):
                raise TypeError(f"{name} must be a number of seconds, got {seconds!r}")
        if math.isnan(at):
            raise ValueError("at must be a time or infinite, got nan")
        if not 0 <= reserve_s < math.inf:
            raise ValueError(f"reserve_s must be at least 0 and finite, got {reserve_s}")
        if hypotheses is not None and (isinstance(hypotheses, bool) or not isinstance(hypotheses, Integral)):
            raise TypeError(f"hypotheses must be a whole number or None, got {hypotheses!r}")
        if hypotheses is not None and hypotheses < 0:
            raise ValueError(f"hypotheses must be at least 0, got {hypotheses}")
        self.clock = clock
        self._end = at - reserve_s
        self._dearest_s = self._paused_s = 0.0
        self._left = math.inf if hypotheses is None else hypotheses

    @contextmanager
    def a_pass(self) -> Iterator[None]:
        """Learn what a pass costs, for the length of a block."""
        started = self.clock()
        yield
        self._dearest_s = max(self._dearest_s, self.clock() - started)

    def expect(self, pass_s: float) -> None:
        """A pass is known to cost so much."""
        self._dearest_s = max(self._dearest_s, pass_s)

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Let others work for the length of a block, which is no measure of what anything costs."""
        began = self.clock()
        yield
        self._paused_s += self.clock() - began

    def another_fits(self, takes_a_pass: bool = True) -> bool:
        """Whether one more hypothesis may be tested: its pass is expected to end in time. It then counts as tested."""
        fits = self._left > 0 and self.clock() + SAFETY * self._dearest_s * takes_a_pass <= self._end
        self._left -= fits
        return fits

    def room(self, most: int) -> int:
        """How many hypotheses, at most so many, may be decoded at once with another one.

        All together may take as long as one after the other.
        """
        left_s, each_s = self._end - self.clock(), SAFETY * self._dearest_s
        if left_s < (most + 1) * each_s:
            most = int(left_s / each_s) - 1 if each_s > 0 else 0
        return int(max(0, min(most, self._left)))

    def reading(self, share: float) -> Callable[[Collection[str]], bool]:
        """Whether there is time to read the messages of some agents, to be asked of one group after another just before
        each is read. All together get a share of the time that is left now.
        """
        began = self.clock()
        end, dearest_s, before = began + share * (self._end - began), 0.0, began - self._paused_s

        def fits(_: Collection[str]) -> bool:
            nonlocal before, dearest_s
            now = self.clock()
            worked = now - self._paused_s
            before, dearest_s = worked, max(dearest_s, worked - before)
            return now + SAFETY * dearest_s <= end

        return fits

    @property
    def is_met(self) -> bool:
        """Whether there is time left for what was reserved."""
        return self.clock() <= self._end


class Recorded(Deadline):
    """One that passed after so many hypotheses, if it did, and without the testimony of some teammates, to make a
    decision again that time cut short.
    """

    def __init__(self, hypotheses: int | None, unread: Collection[str] = ()) -> None:
        super().__init__(hypotheses=hypotheses)
        self._unread = frozenset(unread)

    def reading(self, share: float) -> Callable[[Collection[str]], bool]:  # noqa: ARG002 (it is known what was read)
        """As it was: all but those groups in which somebody's was not read."""
        return self._unread.isdisjoint
