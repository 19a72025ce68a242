"""Sessions and audit logs in SQLite or PostgreSQL."""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

from sqlalchemy import Connection, Row, bindparam, delete, func, insert, select, text, update

from robosac.audit import digest, seal
from service.keeping import migrations
from service.keeping.database import connect
from service.keeping.store import AuditEvent, FrameDecided, SessionChanged, SessionOver, SessionRecord
from service.keeping.tables import audit_lines, kept_messages, secrets, sessions

REMEMBERED = 4096
"""Sessions that `SqlStore.seen` knows."""

_JSON = frozenset({"teammates", "defense", "token_ids", "public_keys", "state"})
_FIELDS = tuple(field.name for field in fields(SessionRecord))
_THIS = sessions.c.session_id == bindparam("this")
_OPEN = sessions.c.ended_at.is_(None)
_GET = select(*(sessions.c[name] for name in _FIELDS)).where(_THIS)
_GET_TO_CHANGE = _GET.with_for_update()  # SQLite, which knows no such clause, has locked everything by then
_CHANGE = update(sessions).where(_THIS)
_LINES = (
    select(audit_lines.c.line)
    .where(audit_lines.c.session_id == bindparam("this"), audit_lines.c.seq > bindparam("after"))
    .order_by(audit_lines.c.seq)
)
_MESSAGES = select(kept_messages.c.body).where(
    kept_messages.c.session_id == bindparam("this"), kept_messages.c.frame == bindparam("number")
)
_FORGET_MESSAGES = delete(kept_messages).where(
    kept_messages.c.session_id == bindparam("this"), kept_messages.c.frame < bindparam("before")
)
_FORGET = delete(sessions).where(_THIS)
_UNUSED = select(sessions.c.session_id).where(_OPEN, sessions.c.touched_at < bindparam("moment"))
_ENDED = select(sessions.c.session_id).where(
    sessions.c.ended_at.is_not(None), sessions.c.touched_at < bindparam("moment")
)
_COUNT = select(func.count()).select_from(sessions).where(_OPEN)
_KEEP_SECRET = text("INSERT INTO secrets (name, value) VALUES (:name, :value) ON CONFLICT DO NOTHING")
_SECRET = select(secrets.c.value).where(secrets.c.name == bindparam("this"))

Change = Callable[[SessionRecord], Mapping[str, Any]]


class SqlStore:
    """`service.keeping.store.Store` on a database.

    Every method is a transaction that holds the session's row while it numbers and seals the log's next line, so that
    a log never has two ends. `get` always asks the database; what the methods learn of a session, `seen` tells.

    Parameters
    ----------
    url : str
        As `service.keeping.database.read_url`.

    Raises
    ------
    ValueError
        If the URL is none.
    """

    def __init__(self, url: str) -> None:
        self._database = connect(url)
        self._seen: OrderedDict[str, SessionRecord] = OrderedDict()

    async def start(self) -> None:
        """Bring the database to this version's schema."""
        await self._database.write(migrations.upgrade)

    async def create(self, record: SessionRecord, event: AuditEvent) -> None:
        line = seal(event, record.session_id, 1, record.audit_head)
        kept = replace(record, audit_seq=1, audit_head=digest(line))

        def work(connection: Connection) -> None:
            connection.execute(insert(sessions), _columns(kept, *_FIELDS))
            connection.execute(insert(audit_lines), {"session_id": kept.session_id, "seq": 1, "line": line})

        await self._database.write(work)
        self._remember(kept)

    async def get(self, session_id: str) -> SessionRecord | None:
        if not (session_id.isascii() and session_id.isprintable()):  # what no database takes for a text
            return None
        asked, before = {"this": session_id}, self._seen.get(session_id)
        row = await self._database.read(lambda connection: connection.execute(_GET, asked).first())
        if row is None:
            self._seen.pop(session_id, None)
            return None
        if self._seen.get(session_id) is before:  # nothing was written meanwhile: the database is right
            self._seen.pop(session_id, None)
        return self._remember(_record(row))

    def seen(self, session_id: str) -> SessionRecord | None:
        return self._seen.get(session_id)

    async def decide(
        self,
        session_id: str,
        revision: int,
        frame: int,
        state: Mapping[str, Any],
        next_seed: str,
        event: AuditEvent,
        messages: bytes | None = None,
    ) -> None:
        def change(record: SessionRecord) -> Mapping[str, Any]:
            if record.last_frame is not None and frame <= record.last_frame:
                raise FrameDecided(record.last_frame)
            _check_revision(record, revision)
            answered = record.frames_answered + 1
            return {"last_frame": frame, "frames_answered": answered, "state": state, "seed": next_seed}

        def keep(connection: Connection) -> None:
            if messages is not None:
                row = {"session_id": session_id, "frame": frame, "body": messages}
                connection.execute(insert(kept_messages), row)

        await self._append(session_id, event, change, keep)

    async def change_team(
        self,
        session_id: str,
        revision: int,
        teammates: tuple[str, ...],
        token_ids: Mapping[str, str],
        public_keys: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditEvent,
    ) -> None:
        def change(record: SessionRecord) -> Mapping[str, Any]:
            _check_revision(record, revision)
            return {"teammates": teammates, "token_ids": token_ids, "public_keys": public_keys, "state": state}

        await self._append(session_id, event, change)

    async def renew_token(self, session_id: str, vehicle_id: str, token_id: str, event: AuditEvent) -> None:
        await self._append(session_id, event, lambda record: {"token_ids": {**record.token_ids, vehicle_id: token_id}})

    async def log(self, session_id: str, event: AuditEvent) -> None:
        await self._append(session_id, event, lambda _: {})

    async def audit(self, session_id: str, after: int) -> list[str]:
        asked = {"this": session_id, "after": after}
        return await self._database.read(lambda connection: list(connection.execute(_LINES, asked).scalars()))

    async def messages(self, session_id: str, frame: int) -> bytes | None:
        asked = {"this": session_id, "number": frame}
        return await self._database.read(lambda connection: connection.execute(_MESSAGES, asked).scalar())

    async def forget_messages(self, session_id: str, before: int) -> None:
        asked = {"this": session_id, "before": before}
        await self._database.write(lambda connection: connection.execute(_FORGET_MESSAGES, asked))

    async def end(self, session_id: str, ended_at: str, event: AuditEvent) -> None:
        await self._append(session_id, event, lambda _: {"ended_at": ended_at})

    async def unused_since(self, moment: float) -> list[str]:
        asked = {"moment": moment}
        return await self._database.read(lambda connection: list(connection.execute(_UNUSED, asked).scalars()))

    async def purge(self, moment: float) -> None:
        asked = {"moment": moment}
        ended = await self._database.read(lambda connection: list(connection.execute(_ENDED, asked).scalars()))
        for session_id in ended:  # one by one, so that frames need not wait for all
            await self._forget(session_id)
            self._seen.pop(session_id, None)

    async def count(self) -> int:
        return await self._database.read(lambda connection: connection.execute(_COUNT).scalar_one())

    async def secret(self, name: str, make: Callable[[], str]) -> str:
        def work(connection: Connection) -> str:
            connection.execute(_KEEP_SECRET, {"name": name, "value": make()})
            value: str = connection.execute(_SECRET, {"this": name}).scalar_one()
            return value

        return await self._database.write(work)

    async def close(self) -> None:
        await self._database.close()

    async def _forget(self, session_id: str) -> None:
        await self._database.write(lambda connection: connection.execute(_FORGET, {"this": session_id}))

    async def _append(
        self,
        session_id: str,
        event: AuditEvent,
        change: Change,
        keep: Callable[[Connection], None] = lambda _: None,
    ) -> None:
        """Change a session and append to its log, in one transaction."""

        def work(connection: Connection) -> SessionRecord:
            row = connection.execute(_GET_TO_CHANGE, {"this": session_id}).first()
            if row is None or row.ended_at is not None:
                raise SessionOver(session_id)
            record = _record(row)
            changes = change(record)
            line = seal(event, session_id, record.audit_seq + 1, record.audit_head)
            after = replace(
                record,
                **changes,
                audit_seq=record.audit_seq + 1,
                audit_head=digest(line),
                revision=record.revision + bool(changes),
            )
            changed = _columns(after, *changes, "audit_seq", "audit_head", "revision")
            connection.execute(_CHANGE.values(changed), {"this": session_id})
            connection.execute(insert(audit_lines), {"session_id": session_id, "seq": after.audit_seq, "line": line})
            keep(connection)
            return after

        try:
            self._remember(await self._database.write(work))
        except SessionChanged:
            self._seen.pop(session_id, None)
            await self.get(session_id)
            raise

    def _remember(self, record: SessionRecord) -> SessionRecord:
        """Keep the newest that is known of a session, and give it."""
        before = self._seen.get(record.session_id)
        if before is None or record.audit_seq > before.audit_seq:
            self._seen[record.session_id] = record
        self._seen.move_to_end(record.session_id)
        if len(self._seen) > REMEMBERED:
            self._seen.popitem(last=False)
        return self._seen[record.session_id]


def _check_revision(record: SessionRecord, revision: int) -> None:
    if record.revision != revision:
        raise SessionChanged(record.revision)


def _record(row: Row[Any]) -> SessionRecord:
    values = {name: json.loads(value) if name in _JSON else value for name, value in row._mapping.items()}
    return SessionRecord(**{**values, "teammates": tuple(values["teammates"])})


def _columns(record: SessionRecord, *names: str) -> dict[str, Any]:
    """Columns of these fields, as touched now."""
    values = {name: getattr(record, name) for name in names}
    written = {name: json.dumps(value) if name in _JSON else value for name, value in values.items()}
    return {**written, "touched_at": time.time()}
