"""Transactions on SQLite or PostgreSQL, off the event loop's critical path.

Work is a plain function of a connection; each call is one transaction. SQLite has one connection that writes and some
that read, each on a thread of its own; a piece of work goes there as a whole, since on few, busy cores each change of
threads costs more than a statement. Work that waits for the writer is committed together: what each piece did is kept
or undone by itself, but all share one flush to disk, which is what a commit costs.
"""

from __future__ import annotations

import asyncio
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL, ExceptionContext
from sqlalchemy.exc import DisconnectionError, SQLAlchemyError
from sqlalchemy.ext.asyncio import create_async_engine
from sqlalchemy.pool import NullPool, QueuePool

from robosac.extras import need
from robosac.faults import describe
from service.errors import StoreUnavailable
from service.keeping import clock
from service.keeping.limits import UNBOUND, Limits
from service.keeping.place import Place
from service.keeping.together import Piece, Work, do_each, prepare_each
from service.keeping.urls import file_of, read_url

logger = logging.getLogger(__name__)

T = TypeVar("T")

BUSY_TIMEOUT_S = 5.0
"""How long SQLite waits for another process that writes, where the URL names no ``timeout``."""
BUSY_PAUSE_S = 0.01
"""Between two attempts of what SQLite does not wait for by itself."""
COMMAND_TIMEOUT_S = 10.0
"""How long an answer of PostgreSQL is waited for, at least; it gives a statement up itself before (`Limits`)."""
CONNECT_TIMEOUT_S = 5.0
READ_ONLY = "25006"
"""SQLSTATE of a statement that would write where only reading is allowed."""
READERS = 2
WRITTEN_TOGETHER = 64
_creating = threading.Lock()


def _nothing() -> None:
    pass


class Database(Protocol):
    """Where transactions run.

    Whatever goes wrong with the database is a `StoreUnavailable`; of a `write` it is then unknown whether it is kept,
    as when a connection breaks before the answer to a commit. Other exceptions of the work are passed on, and nothing
    is kept.
    """

    failed: bool
    """Whether a `write` has met a fault of the database. It stays so until somebody who saw that all is well says no:
    what is written next may be small enough where a decision is not.
    """

    async def read(self, work: Work[T]) -> T:
        """Run work that only reads."""

    async def write(self, work: Work[T], first: Callable[[], object] = _nothing) -> T:
        """Run work; what it did is kept once this returns.

        ``first`` is done on a thread before the transaction. What it raises, or a fault of the database, keeps the work
        from being done.
        """

    async def prepare(self, work: Work[None]) -> None:
        """As `write`, of what may take long, before anybody is served."""

    async def close(self) -> None:
        """Let go of files and connections."""


def connect(text: str, limits: Limits | None = None) -> Database:
    """The database of a URL; nothing is opened before the first transaction.

    Raises
    ------
    ValueError
        As `read_url`.
    MissingExtra
        For PostgreSQL, if its driver is not installed.
    """
    url = read_url(text)
    return Sqlite(url) if url.get_backend_name() == "sqlite" else Postgres(url, limits or Limits())


class _Failing:
    """What a database knows of its own faults."""

    failed = False

    @contextmanager
    def _changing(self, *failures: type[Exception]) -> Iterator[None]:
        """As `_unavailable`, for a `write`."""
        try:
            with _unavailable(*failures):
                yield
        except StoreUnavailable:
            self.failed = True
            raise


class Postgres(_Failing):
    """PostgreSQL, for several gateways on several machines."""

    def __init__(self, url: URL, limits: Limits) -> None:
        need("asyncpg", "PostgreSQL")
        import asyncpg  # noqa: PLC0415 (most gateways keep their sessions in SQLite and do without)

        self._failures = (asyncpg.PostgresError, asyncpg.InterfaceError)
        patient = {"timeout": CONNECT_TIMEOUT_S, "server_settings": UNBOUND}
        self._patient = partial(
            create_async_engine, url, poolclass=NullPool, hide_parameters=True, connect_args=patient
        )
        self._engine = create_async_engine(
            url,
            pool_size=limits.connections,
            max_overflow=0,
            pool_timeout=CONNECT_TIMEOUT_S,
            hide_parameters=True,
            connect_args={
                **patient,
                "command_timeout": max(COMMAND_TIMEOUT_S, 2 * limits.statement_s),
                "server_settings": limits.of_server(),
            },
        )
        event.listen(self._engine.sync_engine, "handle_error", _leave_what_only_reads)
        event.listen(self._engine.sync_engine, "checkout", _leave_what_is_closed)
        self._reader = self._engine.execution_options(isolation_level="AUTOCOMMIT")

    async def read(self, work: Work[T]) -> T:
        with _unavailable(*self._failures):
            async with self._reader.connect() as connection:
                return await connection.run_sync(work)

    async def write(self, work: Work[T], first: Callable[[], object] = _nothing) -> T:
        if first is not _nothing:
            await asyncio.to_thread(first)
        with self._changing(*self._failures):
            async with self._engine.begin() as connection:
                return await connection.run_sync(work)

    async def prepare(self, work: Work[None]) -> None:
        engine = self._patient()
        try:
            with self._changing(*self._failures):
                async with engine.begin() as connection:
                    await connection.run_sync(work)
        finally:
            await engine.dispose()

    async def close(self) -> None:
        await self._engine.dispose()


def _leave_what_only_reads(context: ExceptionContext) -> None:
    """Connect anew after a refusal to write: a connection to what has become a standby would stay good for nothing."""
    if getattr(context.original_exception, "sqlstate", None) == READ_ONLY:
        context.is_disconnect = True


def _leave_what_is_closed(connection: Any, _record: object, _proxy: object) -> None:
    """Connect anew where the server, or what is between, has hung up on a connection that was idle."""
    if connection.driver_connection.is_closed():
        raise DisconnectionError


class Sqlite(_Failing):
    """One SQLite file in WAL mode, or a database in memory, which has a single connection."""

    def __init__(self, url: URL) -> None:
        file = file_of(url)
        self._place = place = Place(None if file is None else Path(file))
        self._writer = _SqliteThreads(url, 1, place)
        event.listen(self._writer.engine, "begin", _begin_immediate)
        self._readers = None if file is None else _SqliteThreads(url, READERS, place)
        self._waiting: list[tuple[Piece, asyncio.Future[Any]]] = []
        self._writing: asyncio.Task[None] | None = None

    async def read(self, work: Work[T]) -> T:
        if self._readers is None:
            return await self.write(work)
        with _unavailable():
            return await self._readers.run(work)

    async def write(self, work: Work[T], first: Callable[[], object] = _nothing) -> T:
        done: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._waiting.append((Piece(work, first), done))
        if self._writing is None:
            self._writing = asyncio.create_task(self._write_all())
        with self._changing():
            return await done

    async def prepare(self, work: Work[None]) -> None:
        await self.write(work)
        with _unavailable():
            file = self._place.of_everybody()
        if file is not None:
            logger.warning("everybody may read %s or write to it, and it holds secrets (chmod 600)", file)

    async def close(self) -> None:
        if self._writing is not None:
            await self._writing
        if self._readers is not None:
            await self._readers.close()
        await self._writer.close()

    async def _write_all(self) -> None:
        while self._waiting:
            batch, self._waiting = self._waiting[:WRITTEN_TOGETHER], self._waiting[WRITTEN_TOGETHER:]
            outcomes: list[Any] = []
            try:
                pieces = [piece for piece, _ in batch]
                outcomes = await self._writer.run(partial(do_each, pieces=pieces), partial(prepare_each, pieces))
            except BaseException as error:
                outcomes = [error] * len(batch)
            for (_, done), outcome in zip(batch, outcomes, strict=True):
                if done.done():  # whoever asked was cancelled
                    continue
                if isinstance(outcome, BaseException):
                    done.set_exception(outcome)
                else:
                    done.set_result(outcome)
        self._writing = None


class _SqliteThreads:
    """Connections to a SQLite database with as many threads to use them."""

    def __init__(self, url: URL, number: int, place: Place) -> None:
        self.engine: Engine = create_engine(
            url.update_query_dict({"timeout": str(BUSY_TIMEOUT_S), **url.query}),
            poolclass=QueuePool,
            pool_size=number,
            max_overflow=0,
            hide_parameters=True,
            connect_args={"check_same_thread": False},
        )
        event.listen(self.engine, "do_connect", _create_for_us_alone)
        event.listen(self.engine, "connect", _prepare)
        event.listen(self.engine, "connect", lambda *_: place.opened())
        event.listen(self.engine, "close", lambda *_: place.closed())
        self._place = place
        self._threads = ThreadPoolExecutor(number, "sqlite")

    async def run(self, work: Work[T], first: Callable[[], object] = _nothing) -> T:
        """Run work in a transaction on one of the threads, and something before it there."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._run, work, first)

    async def close(self) -> None:
        """Close the connections and end the threads."""
        await asyncio.get_running_loop().run_in_executor(self._threads, self._dispose)
        self._threads.shutdown()

    def _dispose(self) -> None:
        self._save_a_removed_journal()
        self.engine.dispose()

    def _run(self, work: Work[T], first: Callable[[], object]) -> T:
        first()
        try:
            self._place.check()
        except FileNotFoundError:
            self._save_a_removed_journal()
            raise
        with self.engine.begin() as connection:
            self._place.remember()
            return work(connection)

    def _save_a_removed_journal(self) -> None:
        """Write what a journal holds that was removed to the file, before somebody opens that without it. SQLite itself
        does so only once all processes have closed the file.
        """
        pool = self.engine.pool
        if not self._place.lacks_its_journal or not isinstance(pool, QueuePool) or not pool.checkedin():
            return  # a new connection would make a new journal
        with closing(self.engine.raw_connection()) as connection, suppress(sqlite3.Error):
            connection.cursor().execute("PRAGMA wal_checkpoint(TRUNCATE)").close()


def _prepare(connection: Any, _: object) -> None:
    """Leave transactions to us, and see that what is committed survives a power cut."""
    connection.isolation_level = None
    clock.tell_time(connection)
    cursor = connection.cursor()
    _keep_a_journal(cursor)
    for setting in ("synchronous = FULL", "foreign_keys = ON"):
        cursor.execute(f"PRAGMA {setting}")
    cursor.close()


def _keep_a_journal(cursor: sqlite3.Cursor) -> None:
    """WAL mode. Where several gateways set it at once in a new file, SQLite refuses all but one without waiting."""
    until = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            cursor.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() >= until:
                raise
            time.sleep(BUSY_PAUSE_S)
        else:
            return


def _begin_immediate(connection: Connection) -> None:
    """Take the write lock at once: a transaction that read first could not always take it later."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _create_for_us_alone(_dialect: object, _record: object, arguments: list[str], _options: object) -> None:
    """The file holds secrets; SQLite would let everybody read it, and gives its own files the same rights.

    A file that is there is never opened here. To close any descriptor of it drops all locks that this process holds on
    it (POSIX), SQLite's too, and another process then takes the journal for left behind and deletes it
    (https://sqlite.org/howtocorrupt.html, section 2.2). So nobody may connect between this creation and its close.
    """
    if arguments[0] != ":memory:":
        with _creating, suppress(OSError):  # it is there already, or SQLite explains it better
            path = os.path.realpath(arguments[0])  # since a link that leads nowhere yet counts as there
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))


@contextmanager
def _unavailable(*failures: type[Exception]) -> Iterator[None]:
    """Turn what a database may raise, and what its driver may raise unwrapped, into `StoreUnavailable`."""
    expected: tuple[type[Exception], ...] = (SQLAlchemyError, sqlite3.Error, OSError, *failures)
    try:
        yield
    except expected as error:
        cause = getattr(error, "orig", None) or error
        logger.error("the database failed: %s", describe(cause))
        raise StoreUnavailable from error
