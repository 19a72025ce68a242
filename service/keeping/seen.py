"""Sessions as they were last seen, at no cost."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from service.keeping.record import SessionRecord


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
