"""The audit log in PostgreSQL, in a part for each day: to forget a day is to drop its part, not to delete its lines.

A line is put into the part of the day on which it is written (UTC), by the database's clock: a gateway whose own is set
to another day finds its part all the same. What was there before the log had parts is the part
of day 0. A part can be dropped when no session whose log can still be read has a line in it.
"""

from __future__ import annotations

import logging
import re
from datetime import UTC, datetime

from sqlalchemy import Connection, TextClause, select, text
from sqlalchemy.exc import DBAPIError

from robosac.faults import describe
from service.keeping import migrations
from service.keeping.clock import DAY_S, Today

logger = logging.getLogger(__name__)

AHEAD = 3
"""Days after today for which there are parts already."""
LOCK_MS = 50
"""How long a change of parts waits for a lock, while others wait for it; then the next sweep tries again."""
_NAME = re.compile(r"audit_lines_(\d{8})")
BEFORE = "audit_lines_before"
"""The part of day 0."""
_PARTS = text("SELECT inhrelid::regclass::text FROM pg_inherits WHERE inhparent = 'audit_lines'::regclass ORDER BY 1")


def day(moment: float) -> int:
    """Number of a moment's day (Unix time)."""
    return int(moment // DAY_S)


def are_there(connection: Connection) -> bool:
    """Whether the database keeps the log in parts."""
    return connection.dialect.name == "postgresql"


def make_ahead(connection: Connection) -> None:
    """Make the parts of today and the next days, where they are missing.

    A part is made apart and attached then: that waits for no reader of the log, such as a backup that takes hours. What
    fails all the same is only told as long as today has a part: lines are kept, and the next sweep tries again.
    """
    if not are_there(connection):
        return
    today: int = connection.execute(select(Today())).scalar_one()
    wanted = {name_of(number): number for number in range(today, today + AHEAD + 1)}
    if set(connection.execute(_PARTS).scalars()) >= wanted.keys():
        return
    migrations.lock(connection)
    known = set(connection.execute(_PARTS).scalars())
    try:
        with connection.begin_nested():
            _wait_briefly(connection)
            for name, number in wanted.items():
                if name not in known:
                    values = f"FOR VALUES FROM ({number}) TO ({number + 1})"
                    connection.execute(text(f"CREATE TABLE {name} (LIKE audit_lines INCLUDING DEFAULTS)"))
                    connection.execute(text(f"ALTER TABLE audit_lines ATTACH PARTITION {name} {values}"))
    except DBAPIError as error:
        if name_of(today) not in known or error.connection_invalidated:
            raise
        logger.warning("no part of the audit log was made for the next days: %s", describe(error.orig or error))


def old(connection: Connection, before: float) -> list[str]:
    """Parts of days that ended before then (Unix time)."""
    return [name for name in connection.execute(_PARTS).scalars() if _day_of(name) < day(before)]


def drop_if_finished(connection: Connection, name: str) -> None:
    """Forget a part, if it is still there and no log has a line in it that can still be read.

    From before the look to the end nobody writes to it. It can be read all the same: whoever reads has a lock on the
    whole log by then, and to drop a part takes one, too.
    """
    migrations.lock(connection)  # others may be about to do the same
    if name not in connection.execute(_PARTS).scalars().all():
        return
    _wait_briefly(connection)
    connection.execute(text(f"LOCK TABLE {name} IN SHARE MODE"))
    if not connection.execute(_any_of(name)).first():
        connection.execute(text(f"DROP TABLE {name}"))


def name_of(number: int) -> str:
    """The part of a day."""
    return f"audit_lines_{datetime.fromtimestamp(number * DAY_S, UTC):%Y%m%d}"


def _day_of(name: str) -> float:
    found = _NAME.fullmatch(name)
    if found is None:
        return 0 if name == BEFORE else float("inf")  # somebody else's
    return day(datetime.strptime(found[1], "%Y%m%d").replace(tzinfo=UTC).timestamp())


def _any_of(name: str) -> TextClause:
    return text(
        "SELECT 1 FROM sessions WHERE token_ids <> '{}' AND EXISTS "
        f"(SELECT 1 FROM {name} AS part WHERE part.session_id = sessions.session_id) LIMIT 1"
    )


def _wait_briefly(connection: Connection) -> None:
    connection.execute(text(f"SET LOCAL lock_timeout = {LOCK_MS}"))
