"""Sessions as they were last seen, at no cost."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

from service.errors import SessionLost
from service.keeping.record import SessionRecord

logger = logging.getLogger(__name__)
HeadOf = Callable[[int], str | None]
"""The digest of a record of a session's log, by its number; None if it is not there."""


class Seen:
    """The latest sessions that were read or written.

    Parameters
    ----------
    most : int
        Sessions that are remembered.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._sessions: OrderedDict[str, SessionRecord] = OrderedDict()

    def get(self, session_id: str) -> SessionRecord | None:
        """A session as it was last seen, or None."""
        return self._sessions.get(session_id)

    def forget(self, session_id: str) -> None:
        """Know nothing of a session any more."""
        self._sessions.pop(session_id, None)

    def check(self, now: SessionRecord, head_of: HeadOf) -> None:
        """Refuse to add to a session that the database, which has it so, has lost records of. Others in their place
        would contradict what was promised, and be drawn by seeds that were told before.

        Raises
        ------
        SessionLost
        """
        before = self._sessions.get(now.session_id)
        if before is not None and has_lost(now, before, head_of):
            logger.error(
                "the database went back: the log of session %s ends with record %d, and record %d was kept before, or "
                "another one of its number; was a backup put in its place?",
                *(now.session_id, now.audit_seq, before.audit_seq),
            )
            raise SessionLost

    def remember(self, record: SessionRecord) -> SessionRecord:
        """Keep the newest that is known of a session, and give it; of an ended one without what can be long."""
        if record.ended_at is not None:
            record = replace(record, defense={}, state={})
        before = self._sessions.get(record.session_id)
        if before is None or record.audit_seq > before.audit_seq:
            self._sessions[record.session_id] = record
        self._sessions.move_to_end(record.session_id)
        newest = self._sessions[record.session_id]
        if len(self._sessions) > self._most:
            self._sessions.popitem(last=False)
        return newest


def has_lost(now: SessionRecord, before: SessionRecord, head_of: HeadOf) -> bool:
    """Whether a session that is so now has lost records that it had before. Another process may have added others in
    their place.
    """
    if now.audit_seq == before.audit_seq:
        return now.audit_head != before.audit_head
    return now.audit_seq < before.audit_seq or head_of(before.audit_seq) != before.audit_head
