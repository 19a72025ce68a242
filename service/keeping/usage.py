"""What is kept for whom."""

from __future__ import annotations

from collections import Counter
from typing import Any
from zlib import crc32

from sqlalchemy import Connection, Select, func, select

from service.errors import Kind, Refused
from service.keeping.rows import ENDED, IN_ROW, OPEN
from service.keeping.tables import kept_messages, sessions

_LOCK = 0x0D5EAD
"""First number of the advisory locks of keys in PostgreSQL, chosen at random."""


def open_sessions(key_id: str | None = None) -> Select[Any]:
    """The number of open sessions, of all API keys or of one."""
    of_key = () if key_id is None else (sessions.c.key_id == key_id,)
    return select(func.count()).select_from(sessions).where(OPEN, *of_key)


def check_room(connection: Connection, key_id: str, most: int) -> None:
    """Refuse a key that has as many open sessions as it may; no other process opens one for it from now on to the
    transaction's end.

    Raises
    ------
    Refused
        With ``too-many-sessions``.
    """
    if connection.dialect.name == "postgresql":
        number = crc32(key_id.encode()) - 2**31
        connection.execute(select(func.pg_advisory_xact_lock(_LOCK, number)))
    if all(connection.execute(open_sessions(of)).scalar_one() >= most for of in (None, key_id)):  # the first is quick
        raise Refused(Kind.TOO_MANY_SESSIONS, f"a key may have {most} open sessions (ROBOSAC_MAX_SESSIONS_PER_KEY)")


def of_keys(connection: Connection) -> Counter[str]:
    """Bytes that are kept of the sessions of each API key, open or ended; of open ones the messages kept now, too."""
    kept: Counter[str] = Counter()
    nbytes, messages = sessions.c.kept_bytes, func.length(kept_messages.c.body)
    for some, kept_of, of in (
        (OPEN, nbytes + IN_ROW, sessions),
        (OPEN, messages, sessions.join(kept_messages, kept_messages.c.session_id == sessions.c.session_id)),
        (ENDED, nbytes, sessions),  # of whom there may be many: an index alone sums those
    ):
        query = select(sessions.c.key_id, func.sum(kept_of)).select_from(of).where(some).group_by(sessions.c.key_id)
        kept.update({key_id: int(total) for key_id, total in connection.execute(query)})
    return kept
