"""Brings a database to the schema of this version."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection, func, inspect, select, text

from service.keeping.tables import metadata

HEAD = "0007"
"""The latest step."""
_ENCODINGS = ("UTF8", "SQL_ASCII")
"""Of PostgreSQL, that take every character: a log repeats what vehicles send."""
_LOCK = 0x0D5EAC
"""Number of the advisory lock that processes starting at once take in PostgreSQL, chosen at random."""


def upgrade(connection: Connection) -> None:
    """Take the steps that are missing, in the transaction of the connection; nobody else takes them meanwhile.

    In SQLite the transaction must be an immediate one.

    Raises
    ------
    ValueError
        If the database is of a later version than this one, or of another program, or cannot keep every text; or if
        tables are gone.
    """
    _check_encoding(connection)
    lock(connection)
    revision = _revision(connection)
    if revision == HEAD:
        _check_tables(connection)
        return
    from alembic import command  # noqa: PLC0415 - 0.2 s that most starts need not spend
    from alembic.config import Config  # noqa: PLC0415
    from alembic.util import CommandError  # noqa: PLC0415

    config = Config(Path(__file__).parent / "alembic.ini")
    config.attributes["connection"] = connection
    try:
        command.upgrade(config, "head")
    except CommandError as error:
        raise ValueError(
            f"the database is of a later version of the gateway, or another program's: its schema is {revision}, "
            f"this version's {HEAD}"
        ) from error


def lock(connection: Connection) -> None:
    """Keep others from changing the schema until the transaction's end."""
    if connection.dialect.name == "postgresql":
        connection.execute(select(func.pg_advisory_xact_lock(_LOCK)))


def _check_encoding(connection: Connection) -> None:
    if connection.dialect.name != "postgresql":
        return
    encoding = connection.execute(text("SHOW server_encoding")).scalar()
    if encoding not in _ENCODINGS:
        raise ValueError(f"the database's encoding is {encoding}, in which not every text can be kept; make it UTF8")


def _check_tables(connection: Connection) -> None:
    missing = sorted(set(metadata.tables).difference(inspect(connection).get_table_names()))
    if missing:
        raise ValueError(f"the database is damaged: it has no table {', '.join(missing)}; put a backup in its place")


def _revision(connection: Connection) -> str | None:
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
