"""How an ended session is forgotten, a little at a time: whoever writes waits for no more than a few milliseconds."""

from __future__ import annotations

from collections.abc import Iterator

from sqlalchemy import Delete, Update, delete, select, update

from service.keeping.tables import audit_lines, kept_messages, sessions

LINES_TOGETHER = 512
MESSAGES_TOGETHER = 1
"""Frames, of a megabyte or so each."""


def locked(session_id: str) -> Update:
    """Takes all tokens of the session away, so that nobody reads a log that is half gone."""
    return update(sessions).where(sessions.c.session_id == session_id).values(token_ids="{}")


def parts(session_id: str) -> Iterator[Delete]:
    """What to delete, one after another, each as often as there is something: messages, then the log, then the rest."""
    for table, key, number in (
        (kept_messages, kept_messages.c.frame, MESSAGES_TOGETHER),
        (audit_lines, audit_lines.c.seq, LINES_TOGETHER),
    ):
        of_session = table.c.session_id == session_id
        oldest = select(key).where(of_session).order_by(key).limit(number)
        yield delete(table).where(of_session, key.in_(oldest.scalar_subquery()))
    yield delete(sessions).where(sessions.c.session_id == session_id)


def older_messages(session_id: str, before: int) -> Delete:
    """Those of the session's frames before one, to be deleted."""
    return delete(kept_messages).where(kept_messages.c.session_id == session_id, kept_messages.c.frame < before)
