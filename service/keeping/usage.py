"""What is kept for whom."""

from __future__ import annotations

from collections import Counter

from sqlalchemy import Connection, func, select

from service.keeping.rows import ENDED, OPEN
from service.keeping.tables import sessions


def of_keys(connection: Connection) -> Counter[str]:
    """Bytes that are kept of the sessions of each API key, open or ended."""
    kept: Counter[str] = Counter()
    for some in (OPEN, ENDED):  # apart, as only ended ones are summed by an index alone, and there may be many
        query = select(sessions.c.key_id, func.sum(sessions.c.kept_bytes)).where(some).group_by(sessions.c.key_id)
        kept.update({key_id: int(total) for key_id, total in connection.execute(query)})
    return kept
