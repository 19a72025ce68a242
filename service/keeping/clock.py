"""The clock of this machine beside the database's, which all gateways on it share."""

from __future__ import annotations

import time

from sqlalchemy import Connection, text

_NOW = text("SELECT CAST(extract(epoch FROM clock_timestamp()) AS double precision)")


def ahead_s(connection: Connection) -> float:
    """By how many seconds this machine's clock is ahead of the database's, at least; negative if it is behind.

    SQLite has no clock of its own.
    """
    if connection.dialect.name != "postgresql":
        return 0.0
    before = time.time()
    there: float = connection.execute(_NOW).scalar_one()
    after = time.time()
    return before - there if before > there else min(0.0, after - there)
