"""Sessions and their audit logs, in SQLite or PostgreSQL."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from sqlalchemy import Connection, Delete, Select, Update, insert, select, update

from robosac.audit import FULL_EVERY, digest
from robosac.audit.events import DetectorChanged, Event, FrameAnswered, SessionEnded, TeamChanged, TokenRenewed
from service.errors import (
    AuditFull,
    FrameDecided,
    SessionChanged,
    SessionLost,
    SessionOver,
    StoreUnavailable,
    TokenReplaced,
)
from service.keeping import clock, migrations, once, partitions, purging, usage
from service.keeping.appending import (
    ADD_LINE,
    Change,
    append,
    check_revision,
    check_unused,
    head_of,
    line_row,
    renewal,
)
from service.keeping.database import connect
from service.keeping.limits import Limits
from service.keeping.patience import Patience
from service.keeping.record import SessionRecord
from service.keeping.rows import ADD, ADD_REST, FIELDS, GET, GET_BUT_KNOWN, NO_CHANGE, OPEN, TOUCH, columns, read_row
from service.keeping.sealing import Draft, Ready, Sealing, drafted, sealed
from service.keeping.seen import Seen, has_lost
from service.keeping.shares import Shares
from service.keeping.tables import audit_lines, kept_messages, sessions

logger = logging.getLogger(__name__)

PAGE, REMEMBERED = 128, 4096
"""Audit lines that are read at a time, and sessions that `Store.seen` knows."""


class Store:
    """Keeps sessions and their audit logs.

    What a method did is kept once it returns. One that adds to a session holds its row while it numbers and seals the
    log's next line, so that a log never has two ends; it raises `SessionOver` if the session has ended or is not
    there. Any may raise `StoreUnavailable`.

    Parameters
    ----------
    url : str
        As `service.keeping.urls.read_url`.
    remembered : int
        Sessions that `seen` knows.
    full_every : int
        Frames from one record with the whole state to the next.
    most_records : int, optional
        Records that a log may have, besides the one that ends it; beyond, `AuditFull` is raised.
    limits : service.keeping.database.Limits, optional

    Raises
    ------
    ValueError
        If the URL is none.
    """

    def __init__(
        self,
        url: str,
        remembered: int = REMEMBERED,
        full_every: int = FULL_EVERY,
        most_records: int | None = None,
        limits: Limits | None = None,
    ) -> None:
        self._database = connect(url, limits)
        self._most_records = most_records
        self.shares = Shares(most_records)
        self._sealing = Sealing(full_every, remembered)
        self._seen = Seen(remembered)
        self._room = once.LINE_BYTES
        """What it takes to keep the largest decision that was not kept."""

    async def start(self) -> None:
        """Bring the database to this version's schema."""
        await self._database.prepare(migrations.upgrade)
        await self.make_ahead()

    async def create(self, record: SessionRecord, event: Event, most_of_key: int | None = None) -> SessionRecord:
        """Keep a new session and the first record of its log; the session as it is then.

        Raises
        ------
        Refused
            If its key has ``most_of_key`` open sessions (``too-many-sessions``).
        """
        draft = Draft(lambda: sealed(event, record.session_id, 1, record.audit_head))

        def work(connection: Connection) -> SessionRecord:
            if most_of_key is not None:
                usage.check_room(connection, record.key_id, most_of_key)
            line = draft.made
            kept = replace(record, audit_seq=1, audit_head=digest(line), kept_bytes=len(line.encode()))
            connection.execute(ADD, columns(kept, *FIELDS))
            connection.execute(ADD_LINE, line_row(kept.session_id, 1, line))
            return kept

        await asyncio.to_thread(draft.write)
        return self._seen.remember(await self._database.write(work))

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session as the database has it, ended or not, or None."""
        if not (session_id.isascii() and session_id.isprintable()):  # what no database takes for a text
            return None
        asked, before = {"this": session_id}, self._seen.get(session_id)

        def look(connection: Connection) -> tuple[SessionRecord | None, bool]:
            if before is not None and before.ended_at is None:
                row = connection.execute(GET_BUT_KNOWN, asked).first()
                if row is not None and (row.revision, row.audit_head) == (before.revision, before.audit_head):
                    return read_row(row, before), False
            row = connection.execute(GET, asked).first()
            if row is None:
                return None, before is not None and before.ended_at is None
            record = read_row(row)
            return record, before is not None and has_lost(record, before, partial(head_of, connection, session_id))

        record, lost = await self._database.read(look)
        if lost:  # what was promised is not forgotten
            if record is None:
                gone = "session %s is gone: it ended elsewhere and was purged, or the database went back"
                logger.warning(gone, session_id)
            return record
        if record is None:
            self._seen.forget(session_id)
            return None
        if self._seen.get(session_id) is before:  # nothing was written meanwhile: the database is right
            self._seen.forget(session_id)
        newest = self._seen.remember(record)
        return newest if record.ended_at is None else record

    def seen(self, session_id: str) -> SessionRecord | None:
        """The session as it was here last, if it is remembered; another process may have changed it since."""
        return self._seen.get(session_id)

    async def decide(
        self,
        record: SessionRecord,
        event: FrameAnswered,
        next_seed: str,
        messages: bytes | None = None,
        patience: Patience | None = None,
        keep_frames: int = 0,
    ) -> SessionRecord:
        """Keep a decision: the frame is answered, the defence's state and the seed are the new ones, the log says so.

        Parameters
        ----------
        record : SessionRecord
            The session that the decision was worked out from.
        event : FrameAnswered
        next_seed : str
        messages : bytes, optional
            The frame's messages (`robosac.wire.pack_frame`), where they are kept.
        patience : Patience, optional
            Of whoever waits. By default it does not end.
        keep_frames : int
            Latest frames whose messages stay; those of earlier ones are forgotten. By default none are.

        Returns
        -------
        SessionRecord
            The session with the decision.

        Raises
        ------
        FrameDecided
            If a frame of this number or a higher one is decided.
        SessionChanged
            If the session is of another revision by now.
        GivenUp
            If the patience ended before the commit; nothing is kept.
        """
        patience = patience or Patience()

        def change(now: SessionRecord) -> Mapping[str, Any]:
            patience.check()
            if now.last_frame is not None and event.frame <= now.last_frame:
                raise FrameDecided(event.frame)
            check_revision(now, record)
            answered = now.frames_answered + 1
            return {"last_frame": event.frame, "frames_answered": answered, "state": event.state, "seed": next_seed}

        def keep(connection: Connection) -> None:
            if messages is not None:
                row = {"session_id": record.session_id, "frame": event.frame, "body": messages}
                connection.execute(insert(kept_messages), row)
                if keep_frames:
                    connection.execute(purging.older_messages(record.session_id, event.frame - keep_frames + 1))
            patience.commit()

        draft = self._sealing.decision(record.session_id, event, record.last_frame)
        try:
            kept = await self._append(record.session_id, event, change, keep, draft)
        except StoreUnavailable:
            self._room = max(self._room, len(messages or b"") + once.LINE_BYTES)
            raise
        self._sealing.follow(record.session_id, draft.made.following)
        return kept

    async def change_team(
        self, record: SessionRecord, event: TeamChanged, token_ids: Mapping[str, str]
    ) -> SessionRecord:
        """Keep a new team of a session, with its tokens and keys and the defence's state for it; the session with it.

        Raises
        ------
        SessionChanged
            If the session is not of the revision of ``record`` any more.
        """

        def change(now: SessionRecord) -> Mapping[str, Any]:
            check_revision(now, record)
            kept = {"teammates": event.teammates, "public_keys": event.public_keys, "state": event.state}
            return {**kept, "token_ids": token_ids}

        return await self._append(record.session_id, event, change)

    async def change_detector(self, record: SessionRecord, event: DetectorChanged) -> SessionRecord:
        """Let a session go on with other weights; the session with them.

        Raises
        ------
        SessionChanged
            If the session is not of the revision of ``record`` any more.
        """

        def change(now: SessionRecord) -> Mapping[str, Any]:
            check_revision(now, record)
            return {"weights_digest": event.weights_digest, "calibration_digest": event.calibration_digest}

        return await self._append(record.session_id, event, change)

    async def renew_token(self, session_id: str, before: str, token_id: str, event: TokenRenewed) -> SessionRecord:
        """Let another token of a vehicle count instead of ``before``; `TokenReplaced` if that one counts no more."""
        return await self._append(session_id, event, renewal(event.vehicle_id, before, token_id))

    async def hold(self, session_id: str, holder: str) -> None:
        """Note which process a session's ego asks now; that changes nothing that was decided."""
        await self._execute(update(sessions).where(sessions.c.session_id == session_id).values(holder=holder))

    async def holders(self, session_ids: Collection[str]) -> dict[str, str]:
        """Which process the ego of each of these asks."""
        query = select(sessions.c.session_id, sessions.c.holder).where(sessions.c.session_id.in_(session_ids))
        return await self._database.read(lambda connection: {row[0]: row[1] for row in connection.execute(query)})

    async def log(self, session_id: str, event: Event, *checks: Callable[[SessionRecord], None]) -> None:
        """Append to a session's log, unless one of the ``checks`` of the session as it is then raises."""

        def change(now: SessionRecord) -> Mapping[str, Any]:
            for check in checks:
                check(now)
            return {}

        await self._append(session_id, event, change)

    async def audit(self, session_id: str, after: int, limit: int = PAGE) -> list[str]:
        """The ``limit`` lines with the numbers after ``after``, in order, or as many of them as there are."""
        numbered = audit_lines.c.seq.between(after + 1, after + limit)
        lines = select(audit_lines.c.line).where(audit_lines.c.session_id == session_id, numbered)
        return await self._column(lines.order_by(audit_lines.c.seq))

    def check_room(self, record: SessionRecord) -> None:
        """Refuse what would be on record in a log that holds as many records as it may.

        Raises
        ------
        AuditFull
        """
        if self._most_records is not None and record.audit_seq >= self._most_records:
            raise AuditFull(record.audit_seq)

    async def messages(self, session_id: str, frame: int) -> bytes | None:
        """The messages kept of a decided frame."""
        of_frame = (kept_messages.c.session_id == session_id, kept_messages.c.frame == frame)
        query = select(kept_messages.c.body).where(*of_frame)
        return await self._database.read(lambda connection: connection.execute(query).scalar())

    async def end(
        self,
        session_id: str,
        event: SessionEnded,
        unused_since: float | None = None,
        *checks: Callable[[SessionRecord], None],
    ) -> None:
        """End a session, unless one of the ``checks`` of it as it is then raises. Its log stays until it is purged;
        what nobody reads any more is forgotten.

        Raises
        ------
        SessionInUse
            If it was used since then (Unix time), where that is given.
        """

        def change(now: SessionRecord) -> Mapping[str, Any]:
            for check in checks:
                check(now)
            return {"ended_at": event.time, "state": {}}

        def keep(connection: Connection) -> None:
            connection.execute(ADD_REST, {"this": session_id})
            connection.execute(once.forget_proofs(session_id))

        first = partial(check_unused, session_id=session_id, since=unused_since)
        await self._append(session_id, event, change, keep, first=first)
        self._sealing.forget(session_id)

    async def unused_since(self, moment: float) -> list[str]:
        """Open sessions to which nothing was added, and that were not touched, since then (Unix time)."""
        return await self._column(select(sessions.c.session_id).where(OPEN, sessions.c.touched_at < moment))

    async def touch(self, used: Mapping[str, float]) -> None:
        """Note when open sessions were used last (Unix time) where that added nothing to them."""
        await self._execute(TOUCH, [{"this": session_id, "used_at": at} for session_id, at in used.items()])

    async def ahead_s(self) -> float:
        """As `service.keeping.clock.ahead_s`."""
        return await self._database.read(clock.ahead_s)

    async def make_ahead(self) -> None:
        """Make room for the lines of the next days, where it is missing."""
        await self._database.write(partitions.make_ahead)

    async def purge(self, moment: float) -> None:
        """Forget the sessions that ended before then (Unix time), as `service.keeping.purging.purge` does."""
        await purging.purge(self._database, moment, self._seen.forget, self._sealing.forget)

    async def count(self, key_id: str | None = None) -> int:
        """Open sessions, of all API keys or of one."""
        query = usage.open_sessions(key_id)
        return await self._database.read(lambda connection: connection.execute(query).scalar_one())

    async def kept_bytes(self) -> Counter[str]:
        """Bytes that are kept of the sessions of each API key."""
        return await self._database.read(usage.of_keys)

    async def ping(self) -> None:
        """Find out whether the database takes changes. It makes none, but after one that failed: a full disk would take
        what changes nothing, or little.
        """
        if self._database.failed:
            await self.make_ahead()
            await self._database.write(partial(once.change, room=self._room))
            await self._database.write(once.changed)
            self._database.failed, self._room = False, once.LINE_BYTES
        else:
            await self._execute(NO_CHANGE)

    async def secret(self, name: str, make: Callable[[], str]) -> str:
        """A secret that outlives the process: what ``make`` gave when it was first asked for."""
        return await self._database.write(lambda connection: once.secret(connection, name, make))

    async def use_proof(self, session_id: str, vehicle_id: str, proof_id: str, ends_at: float, now: float) -> bool:
        """Whether a vehicle's proof is new; it is not from now on. It may be forgotten then (both Unix time)."""
        proof = (session_id, vehicle_id, proof_id, ends_at, now)
        return await self._database.write(lambda connection: once.use_proof(connection, *proof))

    async def close(self) -> None:
        """Let go of files and connections."""
        await self._database.close()

    async def _column(self, query: Select[Any]) -> list[str]:
        return await self._database.read(lambda connection: list(connection.execute(query).scalars()))

    async def _execute(self, statement: Delete | Update, rows: Sequence[Mapping[str, Any]] | None = None) -> int:
        return await self._database.write(lambda connection: int(connection.execute(statement, rows).rowcount))

    async def _append(
        self,
        session_id: str,
        event: Event,
        change: Change,
        keep: Callable[[Connection], None] = lambda _: None,
        draft: Draft[Ready] | None = None,
        first: Callable[[Connection], None] = lambda _: None,
    ) -> SessionRecord:
        """Change a session and append to its log, in one transaction; what takes long is done before it.

        A decision's ``draft`` is made ready on the thread that writes, as each change of threads costs a frame time.
        Anything else is made ready elsewhere: there decisions would wait for it.
        """
        ready = draft or drafted(event)
        if draft is None:
            await asyncio.to_thread(ready.write)

        def work(connection: Connection) -> SessionRecord:
            def checked(now: SessionRecord) -> Mapping[str, Any]:
                self._seen.check(now, partial(head_of, connection, session_id))
                return change(now)

            first(connection)
            after = append(connection, session_id, ready.made.said, checked, self.check_room, ready.made.state)
            keep(connection)
            return after

        try:
            after = await (self._database.write(work) if draft is None else self._database.write(work, draft.write))
        except SessionLost:
            raise
        except (SessionChanged, SessionOver, TokenReplaced):
            await self.get(session_id)
            raise
        self._seen.remember(after)
        return after
