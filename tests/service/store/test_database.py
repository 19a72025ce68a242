"""Migrations, files, and what happens when the database fails."""

import asyncio
import contextlib
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import make_url, text

from clients.errors import SessionNotFound
from robosac import wire
from service.errors import StoreUnavailable
from service.keeping import migrations
from service.keeping.database import _keep_a_journal, connect
from service.keeping.limits import Limits
from service.keeping.store import Store
from service.keeping.tables import metadata
from tests.service.conftest import problem, serve
from tests.service.store.conftest import added, all_of, check_chain, decided, note, opened

INI = Path(migrations.__file__).parent / "alembic.ini"


@contextlib.asynccontextmanager
async def a_database(url):
    database = connect(url)
    try:
        yield database
    finally:
        await database.close()


def differences(connection):
    opts = {"include_name": lambda name, kind, _: kind != "table" or not name.startswith("audit_lines_")}  # parts
    return compare_metadata(MigrationContext.configure(connection, opts=opts), metadata)


async def test_the_steps_lead_to_the_schema_and_taking_them_again_changes_nothing(url):
    async with a_database(url) as database:
        assert len(await database.write(differences)) >= len(metadata.tables)
        for _ in range(2):
            await database.write(migrations.upgrade)
            assert await database.write(differences) == []


def test_the_latest_step_is_the_one_that_is_looked_for():
    assert ScriptDirectory.from_config(Config(INI)).get_heads() == [migrations.HEAD]


async def test_several_stores_may_start_at_once_on_an_empty_database(shared_url):
    stores = [Store(shared_url) for _ in range(6)]
    assert set(await all_of(*(store.start() for store in stores))) == {None}
    sid = await added(stores[0])
    assert (await stores[5].get(sid)).session_id == sid
    for store in stores:
        await store.close()


async def test_a_database_of_a_later_version_is_refused(shared_url):
    async with opened(shared_url):
        pass
    async with a_database(shared_url) as database:
        await database.write(
            lambda connection: connection.execute(text("UPDATE alembic_version SET version_num = '9'"))
        )
    store = Store(shared_url)
    with pytest.raises(ValueError, match=r"later version of the gateway.* its schema is 9, this version's 00"):
        await store.start()
    await store.close()


@pytest.mark.parametrize("table", ["audit_lines", "used_proofs"])
async def test_a_database_that_lost_a_table_is_refused(shared_url, table):
    async with opened(shared_url):
        pass
    async with a_database(shared_url) as database:
        await database.write(lambda connection: connection.execute(text(f"DROP TABLE {table}")))
    store = Store(shared_url)
    with pytest.raises(ValueError, match=f"is damaged: it has no table {table};"):
        await store.start()
    await store.close()


def test_the_steps_can_be_taken_and_undone_by_hand(tmp_path, monkeypatch):
    path = tmp_path / "by-hand.db"
    monkeypatch.setenv("ROBOSAC_DATABASE_URL", f"sqlite:///{path}")
    command.upgrade(Config(INI), "head")
    with contextlib.closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT version_num FROM alembic_version").fetchall() == [(migrations.HEAD,)]
    command.downgrade(Config(INI), "base")
    with contextlib.closing(sqlite3.connect(path)) as connection:
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        assert names == [("alembic_version",)]


async def test_the_file_is_its_owners_and_survives_a_power_cut(tmp_path):
    path = tmp_path / "robosac.db"
    before = os.umask(0)
    try:
        async with opened(f"sqlite:///{path}") as store:
            await added(store)
            files = sorted(tmp_path.iterdir())
            assert [file.name for file in files] == ["robosac.db", "robosac.db-shm", "robosac.db-wal"]
            assert {file.stat().st_mode & 0o777 for file in files} == {0o600}
        async with a_database(f"sqlite:///{path}") as database:
            settings = {
                name: await database.read(lambda c, name=name: c.exec_driver_sql(f"PRAGMA {name}").scalar())
                for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
            }
        assert settings == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 5000}
    finally:
        os.umask(before)


ASKS_FOR_THE_FILE = """
import fcntl, sys
with open(sys.argv[1], "r+b") as file:
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        print("held")
"""


def is_held(path):
    """Whether this process holds a lock on a file; another one asks, since to close it here would drop all locks."""
    command = [sys.executable, "-c", ASKS_FOR_THE_FILE, str(path)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout == "held\n"


async def test_the_file_is_locked_as_long_as_it_is_open(tmp_path):
    path = tmp_path / "robosac.db"
    for number in range(2):
        async with opened(f"sqlite:///{path}") as store:
            assert is_held(path)
            sid = await added(store, number)
            await asyncio.gather(*(store.get(sid) for _ in range(20)))  # each reader opens the file
            await asyncio.gather(*(store.log(sid, note()) for _ in range(20)))
            assert is_held(path)
            for threads in (store._database._writer, store._database._readers):
                threads.engine.dispose()  # as after a fault: all connections are opened again
            await store.get(sid)
            await store.log(sid, note())
            assert is_held(path)
            async with opened(f"sqlite:///{path}") as second:
                await second.get(sid)
            assert is_held(path)
        assert not is_held(path)


async def test_what_another_process_reads_costs_no_decision(tmp_path):
    """It would take itself for the last user and delete the journal, if nobody held a lock."""
    path, copy = tmp_path / "robosac.db", tmp_path / "killed.db"
    async with opened(f"sqlite:///{path}") as store:
        sid = await added(store)
        await store.get(sid)
        reads = "import sqlite3, sys; sqlite3.connect(sys.argv[1]).execute('SELECT * FROM sessions').fetchall()"
        subprocess.run([sys.executable, "-c", reads, str(path)], check=True)
        for _ in range(3):
            await store.log(sid, note())
        for suffix in ("", "-wal"):  # what a kill would leave
            subprocess.run(["cp", f"{path}{suffix}", f"{copy}{suffix}"], check=True)
    with contextlib.closing(sqlite3.connect(copy)) as connection:
        assert connection.execute("SELECT COUNT(*) FROM audit_lines").fetchone() == (4,)
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


async def test_a_new_file_behind_a_link_is_its_owners_too(tmp_path):
    (tmp_path / "robosac.db").symlink_to(tmp_path / "kept.db")
    async with opened(f"sqlite:///{tmp_path}/robosac.db") as store:
        await added(store)
        assert (tmp_path / "kept.db").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("put_in_its_place", ["nothing", "a copy"])
async def test_a_file_that_was_moved_takes_nothing(tmp_path, put_in_its_place):
    path, elsewhere = tmp_path / "robosac.db", tmp_path / "elsewhere.db"
    store = Store(f"sqlite:///{path}")
    await store.start()
    sid = await added(store)
    path.rename(elsewhere)
    if put_in_its_place == "a copy":
        shutil.copy(elsewhere, path)
    for refused in (decided(store, sid, 1), store.get(sid), store.ping(), store.ping()):
        with pytest.raises(StoreUnavailable):
            await refused
    elsewhere.rename(path)
    await decided(store, sid, 1)
    await store.ping()
    await store.close()


async def test_a_start_waits_for_another_one_as_long_as_it_takes(postgres):
    url, holding = await postgres.new_database(), asyncio.Event()
    await postgres.do(f"ALTER DATABASE {make_url(url).database} SET lock_timeout = 100")  # as an operator may have it
    first, second = connect(url), Store(url, limits=Limits(statement_s=0.1))

    def slow(connection):
        migrations.lock(connection)
        loop.call_soon_threadsafe(holding.set)
        connection.execute(text("SELECT pg_sleep(1)"))

    loop = asyncio.get_running_loop()
    upgrading = asyncio.create_task(first.prepare(slow))
    await holding.wait()
    await second.start()
    assert upgrading.done()
    await all_of(upgrading, first.close(), second.close())


async def test_a_database_that_is_not_there_is_unavailable(tmp_path):
    for url in (f"sqlite:///{tmp_path}/no/such/folder/x.db", f"postgresql://nobody@/x?host={tmp_path}"):
        store = Store(url)
        for call in (store.start(), store.count(), store.get("0" * 32)):
            with pytest.raises(StoreUnavailable):
                await call
        await store.close()


async def test_while_another_process_holds_the_file_nothing_is_acknowledged_and_then_it_goes_on(tmp_path, good_frame):
    path = tmp_path / "robosac.db"
    async with serve(database_url=f"sqlite:///{path}?timeout=0.05") as served:
        session = await served.open()
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            refused = await served.post(session, "frames", good_frame(1))
            problem(refused, 503, "store-unavailable")
            assert refused.headers["retry-after"] == "1"
            opening = await served.http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"]})
            problem(opening, 503, "store-unavailable")
            assert (await served.ego(session).state())["last_frame"] == 0
            other.execute("ROLLBACK")
        assert (await served.post(session, "frames", good_frame(1))).status_code == 200
        log = [record["frame"] for record in await served.ego(session).audit() if "frame" in record]
        assert log == [0, 1]


async def test_a_gateway_serves_from_each_database(shared_url, good_frame):
    async with serve(database_url=shared_url, keep_frames=1) as served:
        session = await served.open()
        ego = served.ego(session)
        for frame in (0, 1):
            assert (await served.post(session, "frames", good_frame(frame))).json()["source"] == "consensus"
        problem(await served.post(session, "frames", good_frame(1)), 409, "stale-frame")
        kept = wire.unpack(await ego.kept_messages(1))
        assert {"after", "before"} == kept.pop("states").keys()
        assert kept == wire.unpack(good_frame(1))
        with pytest.raises(SessionNotFound, match="messages-not-kept"):
            await ego.kept_messages(0)
        await ego.dismiss("rsu")
        await ego.close()
        events = [record["event"] for record in await ego.audit()]
        refused = ["message_refused"]
        assert events == ["session_opened", *["frame_answered"] * 2, *refused, "team_changed", "session_ended"]


async def test_a_server_that_goes_away_and_comes_back(postgres):
    async with opened(await postgres.new_database()) as store:
        sid = await added(store)
        assert set(await all_of(*(store.log(sid, note()) for _ in range(10)))) == {None}
        postgres.stop()
        try:
            failed = await all_of(*(store.log(sid, note()) for _ in range(5)), store.get(sid))
        finally:
            postgres.start()
        assert {type(outcome) for outcome in failed} == {StoreUnavailable}
        for _ in range(30):  # connections that broke are found out one by one
            with contextlib.suppress(StoreUnavailable):
                await store.log(sid, note(event="again"))
                break
        assert "again" in (await check_chain(store, sid))[-1]


async def test_a_server_that_hung_up_on_idle_connections_is_connected_to_anew(postgres):
    url = await postgres.new_database()
    async with opened(url) as store:
        sid = await added(store)
        await all_of(*(store.get(sid) for _ in range(5)))
        name = make_url(url).database
        await postgres.do(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name}'")
        await asyncio.sleep(0.1)
        assert await store.log(sid, note()) is None
        assert (await store.get(sid)).session_id == sid
        await store.ping()
        assert len(await check_chain(store, sid)) == 2


async def test_a_write_goes_on_when_who_asked_has_gone(store):
    sid = await added(store)
    asking = asyncio.create_task(store.log(sid, note()))
    await asyncio.sleep(0)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    await store.log(sid, note())
    assert len(await check_chain(store, sid)) in (2, 3)


async def test_what_comes_before_a_transaction_fails_alone(url):
    """All three are written together where a database does that."""
    done = []

    def fail():
        raise ZeroDivisionError

    def work(name):
        return lambda _: done.append(name)

    async with a_database(url) as database:
        await database.write(work("0"))
        asked = [
            database.write(work("a"), lambda: done.append("before a")),
            database.write(work("b"), fail),
            database.write(work("c")),
        ]
        outcomes = await asyncio.gather(*asked, return_exceptions=True)
    assert [type(outcome) for outcome in outcomes] == [type(None), ZeroDivisionError, type(None)]
    assert sorted(done) == ["0", "a", "before a", "c"]
    assert done.index("before a") < done.index("a")


def test_the_journal_is_waited_for_where_sqlite_does_not(tmp_path):
    path = tmp_path / "robosac.db"
    other = sqlite3.connect(path, check_same_thread=False)
    other.execute("BEGIN EXCLUSIVE")
    cursor = sqlite3.connect(path, timeout=0).cursor()
    with pytest.raises(sqlite3.OperationalError, match="database is locked"):
        cursor.execute("PRAGMA journal_mode = WAL")
    release = threading.Timer(0.1, other.rollback)
    release.start()
    _keep_a_journal(cursor)
    release.join()
    assert cursor.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    cursor.connection.close()
    other.close()


def test_what_is_no_lock_is_not_waited_for(tmp_path):
    path = tmp_path / "robosac.db"
    path.touch()
    attempts = []
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    connection.set_trace_callback(attempts.append)
    with pytest.raises(sqlite3.OperationalError, match="readonly"):
        _keep_a_journal(connection.cursor())
    assert len(attempts) == 1
    connection.close()
