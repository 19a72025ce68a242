"""How ended sessions are forgotten, a little at a time: whoever writes waits for no more than a few milliseconds.

In PostgreSQL their lines go with the parts of the days on which they were written, once nobody can read any line of a
part (`service.keeping.partitions`). So lines are deleted one by one only where the log has no parts, where logs are
kept for less than a day, and in a part that some session's log keeps from being dropped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from sqlalchemy import Column, Delete, Select, Table, Update, delete, exists, select, tuple_, update

from service.keeping import partitions
from service.keeping.clock import DAY_S
from service.keeping.database import Database
from service.keeping.rows import ENDED
from service.keeping.tables import audit_lines, kept_messages, sessions

LINES_TOGETHER = 512
SESSIONS_TOGETHER = 256
BARE_TOGETHER = 4096
"""Sessions of which nothing else is left, in PostgreSQL: nobody waits for them."""
MESSAGES_TOGETHER = 1
"""Frames, of a megabyte or so each."""


async def purge(database: Database, moment: float, *forget: Callable[[str], None]) -> None:
    """Forget the sessions that ended before then (Unix time), with their logs and messages; each transaction is short.

    Each of ``forget`` is told of each. A log that is half gone is not shown any more.
    """
    has_parts = await database.write(partitions.are_there)
    in_parts = has_parts and moment < time.time() - DAY_S
    ended = select(sessions.c.session_id).where(ENDED, sessions.c.touched_at < moment)
    if in_parts:
        while some := await _ids(database, ended.where(sessions.c.token_ids != "{}").limit(SESSIONS_TOGETHER)):
            await _forget_together(database, some)
            _tell(forget, *some)
    while not in_parts and (some := await _ids(database, ended.limit(SESSIONS_TOGETHER))):
        await _done(database, _locked(some))
        _tell(forget, *some)
        for part in parts(some):
            while await _done(database, part):
                pass
    if has_parts:
        await _drop_parts(database, moment)


def _tell(forget: Sequence[Callable[[str], None]], *session_ids: str) -> None:
    for session_id in session_ids:
        for each in forget:
            each(session_id)


async def _forget_together(database: Database, session_ids: Sequence[str]) -> None:
    """Let nobody read these logs any more, and delete their messages."""
    await _done(database, _locked(session_ids))
    with_messages = select(kept_messages.c.session_id).where(kept_messages.c.session_id.in_(session_ids)).distinct()
    for session_id in await _ids(database, with_messages):
        while await _done(database, _messages([session_id])):
            pass


async def _drop_parts(database: Database, moment: float) -> None:
    for name in await database.read(lambda connection: partitions.old(connection, moment)):
        await database.write(partial(partitions.drop_if_finished, name=name))
    purged = sessions.c.token_ids == "{}"
    its_line = audit_lines.c.session_id == sessions.c.session_id
    pinned = select(sessions.c.session_id).where(
        purged, exists().where(its_line, audit_lines.c.day < partitions.day(moment))
    )
    for session_id in await _ids(database, pinned):
        while await _done(database, _lines([session_id])):
            pass
    # all other lines are of parts that are still there
    gone = ENDED, purged, sessions.c.touched_at < partitions.day(moment) * DAY_S, ~exists().where(its_line)
    some = select(sessions.c.session_id).where(*gone).limit(BARE_TOGETHER).scalar_subquery()
    while await _done(database, delete(sessions).where(sessions.c.session_id.in_(some))):
        pass


async def _ids(database: Database, query: Select[Any]) -> list[str]:
    return await database.read(lambda connection: list(connection.execute(query).scalars()))


async def _done(database: Database, some: Delete | Update) -> int:
    """Rows that it was done to."""
    return await database.write(lambda connection: int(connection.execute(some).rowcount))


def _locked(session_ids: Sequence[str]) -> Update:
    """Takes all tokens of sessions away, so that nobody reads a log that is half gone."""
    return update(sessions).where(sessions.c.session_id.in_(session_ids)).values(token_ids="{}")


def parts(session_ids: Sequence[str]) -> Iterator[Delete]:
    """What to delete, one after another, each as often as there is something: messages, then logs, then the rest."""
    yield _messages(session_ids)
    yield _lines(session_ids)
    yield delete(sessions).where(sessions.c.session_id.in_(session_ids))


def _messages(session_ids: Sequence[str]) -> Delete:
    return _oldest(kept_messages, kept_messages.c.frame, session_ids, MESSAGES_TOGETHER)


def _lines(session_ids: Sequence[str]) -> Delete:
    return _oldest(audit_lines, audit_lines.c.seq, session_ids, LINES_TOGETHER)


def _oldest(table: Table, number: Column[int], session_ids: Sequence[str], most: int) -> Delete:
    """The first so many rows of these sessions, to be deleted."""
    key = table.c.session_id, number
    first = select(*key).where(table.c.session_id.in_(session_ids)).order_by(*key).limit(most)
    return delete(table).where(table.c.session_id.in_(session_ids), tuple_(*key).in_(first))


def older_messages(session_id: str, before: int) -> Delete:
    """Those of the session's frames before one, to be deleted."""
    return delete(kept_messages).where(kept_messages.c.session_id == session_id, kept_messages.c.frame < before)
