"""Sessions as rows of the database, and back."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import fields
from types import NoneType
from typing import Any

from sqlalchemy import BigInteger, Row, bindparam, false, func, insert, literal, select, update
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from robosac.faults import describe
from service.errors import StoreUnavailable
from service.keeping import clock
from service.keeping.record import SEED, SessionRecord
from service.keeping.tables import kept_messages, sessions

logger = logging.getLogger(__name__)

_JSON = ("teammates", "defense", "token_ids", "public_keys", "state")
_NAMES = ("teammates", "token_ids", "public_keys")
"""Of these, what is in them is text."""
ROW_BYTES = 1024
"""What a session's row takes besides those, with its places in indexes."""
FIELDS = tuple(field.name for field in fields(SessionRecord))
_KINDS: Mapping[str, tuple[type, ...]] = {
    "str": (str,),
    "str | None": (str, NoneType),
    "int": (int,),
    "int | None": (int, NoneType),
    "float": (float, int),
    "tuple": (list,),
    "Mapping": (dict,),
}
_READ_AS = {field.name: _KINDS[str(field.type).partition("[")[0]] for field in fields(SessionRecord)}
"""What is in a column that is whole. SQLite keeps a value of any kind in any."""
THIS = sessions.c.session_id == bindparam("this")
OPEN = sessions.c.ended_at.is_(None)
ENDED = sessions.c.ended_at.is_not(None)
GET = select(*(sessions.c[name] for name in FIELDS)).where(THIS)
GET_BUT_KNOWN = select(*(sessions.c[name] for name in FIELDS if name not in {"state", "defense"})).where(THIS)
"""Without what can be long, and is the same as long as the log ends as it did."""
GET_TO_CHANGE = GET.with_for_update()  # SQLite, which knows no such clause, has locked everything by then
GET_BUT_STATE = select(*(sessions.c[name] for name in FIELDS if name != "state")).where(THIS).with_for_update()
GET_TOUCHED = select(sessions.c.touched_at).where(THIS).with_for_update()
CHANGE = update(sessions).where(THIS).values(touched_at=clock.Now())
ADD = insert(sessions).values(touched_at=clock.Now())
TOUCH = (
    update(sessions)
    .where(THIS, OPEN, sessions.c.touched_at < bindparam("used_at"))
    .values(touched_at=bindparam("used_at"))
)
_MESSAGES = select(func.coalesce(func.sum(func.length(kept_messages.c.body)), 0)).where(
    kept_messages.c.session_id == bindparam("this")
)


class _Octets(FunctionElement[int]):
    """Bytes of a text. PostgreSQL tells them without reading a long one."""

    inherit_cache = True
    type = BigInteger()


@compiles(_Octets)
def _octet_length(element: _Octets, compiler: SQLCompiler, **options: Any) -> str:
    return f"octet_length({compiler.process(element.clauses, **options)})"


@compiles(_Octets, "sqlite")
def _length_of_blob(element: _Octets, compiler: SQLCompiler, **options: Any) -> str:
    return f"length(CAST({compiler.process(element.clauses, **options)} AS BLOB))"  # it knows the former since 3.43


IN_ROW = sum((_Octets(sessions.c[name]) for name in _JSON), literal(ROW_BYTES))
"""Bytes of a session's row."""
ADD_REST = CHANGE.values(kept_bytes=sessions.c.kept_bytes + IN_ROW + _MESSAGES.scalar_subquery())
"""Of an ended session: its row changes no more, and no message is forgotten any more before its log is."""
NO_CHANGE = update(sessions).where(false()).values(ended_at=None)
"""A database that takes no changes refuses it all the same; PostgreSQL is asked nothing before the first statement."""


def read_row(row: Row[Any], known: SessionRecord | None = None) -> SessionRecord:
    """The session of a row of `FIELDS`; without its state, where that is not in the row. Of a row of `GET_BUT_KNOWN`
    the rest is as ``known``.

    Raises
    ------
    StoreUnavailable
        If the row is damaged.
    """
    try:
        values = {name: json.loads(value) if name in _JSON else value for name, value in row._mapping.items()}
        if wrong := [name for name, value in values.items() if not _is_whole(name, value)]:
            raise TypeError(f"{', '.join(wrong)} of another kind")
    except (ValueError, TypeError, RecursionError) as error:
        logger.error("the database failed: the row of session %s is damaged: %s", row.session_id, describe(error))
        raise StoreUnavailable from error
    if known is not None and "defense" not in values:
        values |= {"defense": known.defense, "state": known.state}
    return SessionRecord(**{**values, "teammates": tuple(values["teammates"])})


def _is_whole(name: str, value: Any) -> bool:
    """Whether a field can have such a value."""
    if name == "seed":
        return isinstance(value, str) and SEED.fullmatch(value) is not None
    if name == "defense":
        return isinstance(value, dict) and isinstance(value.get("kind", ""), str)
    if name in _NAMES:
        texts = value if name == "teammates" else getattr(value, "values", list)()
        return isinstance(value, _READ_AS[name]) and all(isinstance(text, str) for text in texts)
    return isinstance(value, _READ_AS[name])


def columns(record: SessionRecord, *names: str, state: str | None = None) -> dict[str, Any]:
    """Columns of these fields; ``state`` is the text of the one that is called so, if it is at hand."""
    values = {name: getattr(record, name) for name in names if state is None or name != "state"}
    written = {name: json.dumps(value) if name in _JSON else value for name, value in values.items()}
    return {**written, **({} if state is None else {"state": state})}
