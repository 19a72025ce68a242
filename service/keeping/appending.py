"""One transaction's work: a session changes, and its log grows by a line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from sqlalchemy import Connection, insert, select

from robosac.audit import Unsealed, digest
from service.errors import SessionChanged, SessionInUse, SessionOver, TokenReplaced
from service.keeping.clock import Today
from service.keeping.record import SessionRecord
from service.keeping.rows import CHANGE, GET_BUT_STATE, GET_TO_CHANGE, GET_TOUCHED, columns, read_row
from service.keeping.tables import audit_lines

GROWTH = ("audit_seq", "audit_head", "kept_bytes")
"""Fields that change with every line."""
ADD_LINE = insert(audit_lines).values(day=Today())
"""With `line_row`."""
Change = Callable[[SessionRecord], Mapping[str, Any]]
"""Of a session as it is, the fields that change."""


def append(  # a transaction's work, and what was made ready for it
    connection: Connection,
    session_id: str,
    said: Unsealed,
    change: Change,
    check_room: Callable[[SessionRecord], None],
    state: str | None = None,
) -> SessionRecord:
    """Change a session and append to its log; what it is then.

    ``state`` is the text of the state that the change is to: then nothing long is read or written as JSON here, where
    others wait.

    Raises
    ------
    SessionOver
        If there is no such session, or it has ended.
    """
    row = connection.execute(GET_TO_CHANGE if state is None else GET_BUT_STATE, {"this": session_id}).first()
    if row is None or row.ended_at is not None:
        raise SessionOver
    record = read_row(row)
    changes = change(record)
    if "ended_at" not in changes:  # a full log can still be ended
        check_room(record)
    line = said.seal(session_id, record.audit_seq + 1, record.audit_head)
    after = replace(
        record,
        **changes,
        audit_seq=record.audit_seq + 1,
        audit_head=digest(line),
        kept_bytes=record.kept_bytes + len(line.encode()),
        revision=record.revision + bool(changes),
    )
    changed = columns(after, *changes, *GROWTH, "revision", state=state)
    connection.execute(CHANGE, {"this": session_id, **changed})  # not `values`, so that it is compiled once
    connection.execute(ADD_LINE, line_row(session_id, after.audit_seq, line))
    return after


def line_row(session_id: str, seq: int, line: str) -> Mapping[str, Any]:
    """A line of a log as it is kept."""
    return {"session_id": session_id, "seq": seq, "line": line}


def head_of(connection: Connection, session_id: str, seq: int) -> str | None:
    """The digest of a line of a log, by its number; None if it is not there."""
    query = select(audit_lines.c.line).where(audit_lines.c.session_id == session_id, audit_lines.c.seq == seq)
    line: str | None = connection.execute(query).scalar()
    return None if line is None else digest(line)


def check_revision(now: SessionRecord, worked_out_from: SessionRecord) -> None:
    """Raise SessionChanged if a session is not of the revision that a change was worked out from."""
    if now.revision != worked_out_from.revision:
        raise SessionChanged


def check_unused(connection: Connection, session_id: str, since: float | None) -> None:
    """Raise SessionInUse if a session was used since then (Unix time), where that is given; nobody uses it from now on
    to the transaction's end.
    """
    touched_at = None if since is None else connection.execute(GET_TOUCHED, {"this": session_id}).scalar()
    if touched_at is not None and touched_at >= since:
        raise SessionInUse


def renewal(vehicle_id: str, before: str, token_id: str) -> Change:
    """The change to another token of a vehicle. It raises TokenReplaced unless the one ``before`` still counts: it may
    have been renewed, or its vehicle dismissed, by another process that this one has not heard of.
    """

    def change(now: SessionRecord) -> Mapping[str, Any]:
        if now.token_ids.get(vehicle_id) != before:
            raise TokenReplaced
        return {"token_ids": {**now.token_ids, vehicle_id: token_id}}

    return change
