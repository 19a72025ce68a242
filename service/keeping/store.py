"""Sessions and their audit logs, in SQLite or PostgreSQL."""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

from sqlalchemy import Connection, Delete, Row, Select, bindparam, delete, func, insert, select, text, update

from robosac.audit import digest, seal
from robosac.audit.events import Event, FrameAnswered, SessionEnded, TeamChanged, TokenRenewed
from service.errors import FrameDecided, SessionChanged, SessionOver
from service.keeping import migrations
from service.keeping.database import connect
from service.keeping.record import SessionRecord
from service.keeping.tables import audit_lines, kept_messages, secrets, sessions

REMEMBERED = 4096
"""Sessions that `Store.seen` knows."""

_JSON = frozenset({"teammates", "defense", "token_ids", "public_keys", "state"})
_FIELDS = tuple(field.name for field in fields(SessionRecord))
_THIS = sessions.c.session_id == bindparam("this")
_OPEN = sessions.c.ended_at.is_(None)
_GET = select(*(sessions.c[name] for name in _FIELDS)).where(_THIS)
_GET_TO_CHANGE = _GET.with_for_update()  # SQLite, which knows no such clause, has locked everything by then
_CHANGE = update(sessions).where(_THIS)
_ENDED = sessions.c.ended_at.is_not(None)

Change = Callable[[SessionRecord], Mapping[str, Any]]


class Store:
    """Keeps sessions and their audit logs.

    Every method is one transaction, and what it did is kept once it returns. A method that adds to a session holds the
    session's row while it numbers and seals the log's next line, so that a log never has two ends. It raises
    `SessionOver` if the session has ended or is not there. Any method may raise `StoreUnavailable`.

    Parameters
    ----------
    url : str
        As `service.keeping.database.read_url`.
    remembered : int
        Sessions that `seen` knows.

    Raises
    ------
    ValueError
        If the URL is none.
    """

    def __init__(self, url: str, remembered: int = REMEMBERED) -> None:
        self._database = connect(url)
        self._seen: OrderedDict[str, SessionRecord] = OrderedDict()
        self._remembered = remembered

    async def start(self) -> None:
        """Bring the database to this version's schema."""
        await self._database.write(migrations.upgrade)

    async def create(self, record: SessionRecord, event: Event) -> None:
        """Keep a new session and the first record of its log."""
        line = seal(event.as_json(), record.session_id, 1, record.audit_head)
        kept = replace(record, audit_seq=1, audit_head=digest(line))

        def work(connection: Connection) -> None:
            connection.execute(insert(sessions), _columns(kept, *_FIELDS))
            connection.execute(insert(audit_lines), {"session_id": kept.session_id, "seq": 1, "line": line})

        await self._database.write(work)
        self._remember(kept)

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session as the database has it, ended or not, or None."""
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
        """The session as it was here last, at no cost; another process may have changed it since.

        None if it is not remembered.
        """
        return self._seen.get(session_id)

    async def decide(
        self, record: SessionRecord, event: FrameAnswered, next_seed: str, messages: bytes | None = None
    ) -> None:
        """Keep a decision: the frame is answered, the defence's state and the seed are the new ones, the log says so.

        Parameters
        ----------
        record : SessionRecord
            The session that the decision was worked out from.
        event : FrameAnswered
        next_seed : str
        messages : bytes, optional
            The frame's messages (`robosac.wire.pack_frame`), where they are kept.

        Raises
        ------
        FrameDecided
            If a frame of this number or a higher one is decided.
        SessionChanged
            If the session is of another revision by now.
        """

        def change(now: SessionRecord) -> Mapping[str, Any]:
            if now.last_frame is not None and event.frame <= now.last_frame:
                raise FrameDecided(event.frame)
            _check_revision(now, record)
            answered = now.frames_answered + 1
            return {"last_frame": event.frame, "frames_answered": answered, "state": event.state, "seed": next_seed}

        def keep(connection: Connection) -> None:
            if messages is not None:
                row = {"session_id": record.session_id, "frame": event.frame, "body": messages}
                connection.execute(insert(kept_messages), row)

        await self._append(record.session_id, event, change, keep)

    async def change_team(self, record: SessionRecord, event: TeamChanged, token_ids: Mapping[str, str]) -> None:
        """Keep a new team of a session, with its tokens and keys and the defence's state for it.

        Raises
        ------
        SessionChanged
            If the session is not of the revision of ``record`` any more.
        """

        def change(now: SessionRecord) -> Mapping[str, Any]:
            _check_revision(now, record)
            kept = {"teammates": event.teammates, "public_keys": event.public_keys, "state": event.state}
            return {**kept, "token_ids": token_ids}

        await self._append(record.session_id, event, change)

    async def renew_token(self, session_id: str, token_id: str, event: TokenRenewed) -> None:
        """Let another token of a vehicle count instead of the one before."""
        await self._append(session_id, event, lambda now: {"token_ids": {**now.token_ids, event.vehicle_id: token_id}})

    async def log(self, session_id: str, event: Event) -> None:
        """Append to a session's log."""
        await self._append(session_id, event, lambda _: {})

    async def audit(self, session_id: str, after: int) -> list[str]:
        """Lines with a number above ``after``, in order."""
        of_session = (audit_lines.c.session_id == session_id, audit_lines.c.seq > after)
        return await self._column(select(audit_lines.c.line).where(*of_session).order_by(audit_lines.c.seq))

    async def messages(self, session_id: str, frame: int) -> bytes | None:
        """The messages kept of a decided frame."""
        query = select(kept_messages.c.body).where(
            kept_messages.c.session_id == session_id, kept_messages.c.frame == frame
        )
        return await self._database.read(lambda connection: connection.execute(query).scalar())

    async def forget_messages(self, session_id: str, before: int) -> None:
        """Forget the messages kept of the frames below ``before``."""
        old = (kept_messages.c.session_id == session_id, kept_messages.c.frame < before)
        await self._execute(delete(kept_messages).where(*old))

    async def end(self, session_id: str, event: SessionEnded) -> None:
        """End a session; its log stays until it is purged."""
        await self._append(session_id, event, lambda _: {"ended_at": event.time})

    async def unused_since(self, moment: float) -> list[str]:
        """Open sessions to which nothing was added since then (Unix time)."""
        return await self._column(select(sessions.c.session_id).where(_OPEN, sessions.c.touched_at < moment))

    async def purge(self, moment: float) -> None:
        """Forget the sessions that ended before then (Unix time), with their logs and messages."""
        ended = select(sessions.c.session_id).where(_ENDED, sessions.c.touched_at < moment)
        for session_id in await self._column(ended):  # one by one, so that frames need not wait for all
            await self._execute(delete(sessions).where(sessions.c.session_id == session_id))
            self._seen.pop(session_id, None)

    async def count(self) -> int:
        """Open sessions."""
        query = select(func.count()).select_from(sessions).where(_OPEN)
        return await self._database.read(lambda connection: connection.execute(query).scalar_one())

    async def secret(self, name: str, make: Callable[[], str]) -> str:
        """A secret that outlives the process: what ``make`` gave when it was first asked for."""

        def work(connection: Connection) -> str:
            keep = text("INSERT INTO secrets (name, value) VALUES (:name, :value) ON CONFLICT DO NOTHING")
            connection.execute(keep, {"name": name, "value": make()})
            value: str = connection.execute(select(secrets.c.value).where(secrets.c.name == name)).scalar_one()
            return value

        return await self._database.write(work)

    async def close(self) -> None:
        """Let go of files and connections."""
        await self._database.close()

    async def _column(self, query: Select[Any]) -> list[str]:
        return await self._database.read(lambda connection: list(connection.execute(query).scalars()))

    async def _execute(self, statement: Delete) -> None:
        await self._database.write(lambda connection: connection.execute(statement))

    async def _append(
        self,
        session_id: str,
        event: Event,
        change: Change,
        keep: Callable[[Connection], None] = lambda _: None,
    ) -> None:
        """Change a session and append to its log, in one transaction."""
        said = event.as_json()

        def work(connection: Connection) -> SessionRecord:
            row = connection.execute(_GET_TO_CHANGE, {"this": session_id}).first()
            if row is None or row.ended_at is not None:
                raise SessionOver
            record = _record(row)
            changes = change(record)
            line = seal(said, session_id, record.audit_seq + 1, record.audit_head)
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
        if len(self._seen) > self._remembered:
            self._seen.popitem(last=False)
        return self._seen[record.session_id]


def _check_revision(now: SessionRecord, worked_out_from: SessionRecord) -> None:
    if now.revision != worked_out_from.revision:
        raise SessionChanged


def _record(row: Row[Any]) -> SessionRecord:
    values = {name: json.loads(value) if name in _JSON else value for name, value in row._mapping.items()}
    return SessionRecord(**{**values, "teammates": tuple(values["teammates"])})


def _columns(record: SessionRecord, *names: str) -> dict[str, Any]:
    """Columns of these fields, as touched now."""
    values = {name: getattr(record, name) for name in names}
    written = {name: json.dumps(value) if name in _JSON else value for name, value in values.items()}
    return {**written, "touched_at": time.time()}
