"""The clock of this machine beside the database's, which all gateways on it share."""

from __future__ import annotations

import sqlite3
import time
from typing import Any

from sqlalchemy import BigInteger, Connection, Double, select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

DAY_S = 86_400


class Now(FunctionElement[float]):
    """Unix time by the database's clock: what gateways write must not look older for the clock of one of them."""

    inherit_cache = True
    type = Double()


class Today(FunctionElement[int]):
    """Number of the day (Unix time, UTC) by the same clock."""

    inherit_cache = True
    type = BigInteger()


@compiles(Now)
def _of_server(_: Now, __: SQLCompiler, **___: Any) -> str:
    return "CAST(extract(epoch FROM clock_timestamp()) AS double precision)"


@compiles(Now, "sqlite")
def _of_machine(_: Now, __: SQLCompiler, **___: Any) -> str:
    return "unix_time()"


@compiles(Today)
def _day_of_server(_: Today, __: SQLCompiler, **___: Any) -> str:
    return f"CAST(floor(extract(epoch FROM clock_timestamp()) / {DAY_S}) AS bigint)"


@compiles(Today, "sqlite")
def _day_of_machine(_: Today, __: SQLCompiler, **___: Any) -> str:
    return f"CAST(unix_time() / {DAY_S} AS INTEGER)"  # whose own floor is not everywhere


def tell_time(connection: sqlite3.Connection) -> None:
    """Let a connection of SQLite, which has no clock of its own, know this machine's."""
    connection.create_function("unix_time", 0, time.time)


def ahead_s(connection: Connection) -> float:
    """By how many seconds this machine's clock is ahead of the database's, at least; negative if it is behind.

    SQLite has no clock of its own.
    """
    if connection.dialect.name != "postgresql":
        return 0.0
    before = time.time()
    there: float = connection.execute(select(Now())).scalar_one()
    after = time.time()
    return before - there if before > there else min(0.0, after - there)
