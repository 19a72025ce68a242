"""How much of a log others than its ego may fill. Whoever knows a session's id, or has a token of it, can be refused as
often as it likes; its ego could keep no more decisions once the log is full.
"""

from __future__ import annotations

from dataclasses import dataclass

from service.errors import ShareFull
from service.keeping.record import SessionRecord

PART = 64
"""One record in so many may be a refusal, and as many again an equivocation."""
AT_FIRST = 1024
"""Refusals that may be on record before a frame is answered, if they are no more than that part of a full log."""


@dataclass(frozen=True)
class Shares:
    """Of logs that hold ``most_records``, or any number. How much is taken is told from what is kept of a session: it
    is the same for all processes, and after a start.
    """

    most_records: int | None = None

    def check_refusal(self, now: SessionRecord) -> None:
        """Raise `ShareFull` where no other refusal may be on record."""
        self._check(now, 1)

    def check_equivocation(self, now: SessionRecord) -> None:
        """As `check_refusal`. Refusals leave room for these, which prove a lie."""
        self._check(now, 2)

    def _check(self, now: SessionRecord, parts: int) -> None:
        changed_nothing = now.audit_seq - 1 - now.revision  # the first opened the session; each other change has one
        at_first = AT_FIRST if self.most_records is None else min(AT_FIRST, self.most_records // PART)
        if changed_nothing >= parts * (at_first + now.frames_answered // PART):
            raise ShareFull
