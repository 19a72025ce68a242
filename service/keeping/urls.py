"""The URL by which a database is named."""

from __future__ import annotations

from urllib.parse import parse_qsl

from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError

MOST_TIMEOUT_S = 3600.0
_DRIVERS = {
    "sqlite": "sqlite",
    "postgresql": "postgresql+asyncpg",
    "postgresql+asyncpg": "postgresql+asyncpg",
}
_OPTIONS = {
    "sqlite": ("timeout",),
    "postgresql": (
        *("host", "port", "user", "password", "passfile", "service", "servicefile", "database"),
        *("ssl", "direct_tls", "target_session_attrs", "krbsrvname", "gsslib", "prepared_statement_cache_size"),
    ),
}
"""What may stand behind the question mark. The drivers have more that no text can be given for, and SQLite's takes
anything in silence.
"""


def read_url(text: str) -> URL:
    """A database's URL with its driver.

    Raises
    ------
    ValueError
        If it is none, or of another kind of database, or says what the driver does not understand. The message does
        not show it, since it may hold a password.
    """
    try:
        url = make_url(text)
    except (ArgumentError, ValueError) as error:
        raise ValueError("not a database URL") from error
    if url.drivername not in _DRIVERS:
        raise ValueError(f"a database must be one of {', '.join(_DRIVERS)}, not {url.drivername}")
    kind = url.get_backend_name()
    if kind == "sqlite" and "uri" in url.query:  # which can turn locks off, and name no file
        raise ValueError("a SQLite database is named by its path, not by a URI")
    if not _options_in(text, url) <= set(_OPTIONS[kind]):
        raise ValueError(f"the URL of a {kind} database may have no other option than {', '.join(_OPTIONS[kind])}")
    if kind == "sqlite" and "timeout" in url.query and not _is_timeout(url.query["timeout"]):
        raise ValueError(f"a SQLite database's timeout must be a number of seconds from 0 to {MOST_TIMEOUT_S:g}")
    if not all(0 < port < 65_536 for port in (url.port, _number(url.query.get("port"))) if port is not None):
        raise ValueError("a database's port must be a number from 1 to 65535")
    url = url.set(drivername=_DRIVERS[url.drivername])
    try:
        url.get_dialect()().create_connect_args(url)
    except (ArgumentError, ValueError, TypeError) as error:
        raise ValueError(f"not the URL of a {kind} database") from error
    return url


def file_of(url: URL) -> str | None:
    """The file of a SQLite database; None of one in memory, and of PostgreSQL."""
    path = url.database if url.get_backend_name() == "sqlite" else None
    return None if path in (None, "", ":memory:") else path


def _options_in(text: str, url: URL) -> set[str]:
    """Names of what stands behind the question mark, empty for what has no value. SQLAlchemy drops that, and would open
    another file than one whose name has a question mark.
    """
    if url.get_backend_name() != "sqlite":
        return set(url.query)  # a password may have a question mark
    return {name if value else "" for name, value in parse_qsl(text.partition("?")[2], keep_blank_values=True)}


def _number(value: object) -> int | None:
    return int(value) if isinstance(value, str) and value.isdecimal() else None


def _is_timeout(value: object) -> bool:
    try:
        return isinstance(value, str) and 0 <= float(value) <= MOST_TIMEOUT_S
    except ValueError:
        return False
