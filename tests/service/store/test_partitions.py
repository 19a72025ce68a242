"""The log in a part for each day, in PostgreSQL."""

import asyncio
import contextlib
import time

import asyncpg
import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import text

from service.errors import SessionInUse, SessionOver, StoreUnavailable
from service.keeping import partitions
from service.keeping.clock import DAY_S
from service.keeping.database import connect
from service.keeping.limits import Limits
from service.keeping.partitions import AHEAD, day, name_of
from service.keeping.store import Store
from tests.service.store.conftest import THE_END, added, all_of, check_chain, decided, note, opened
from tests.service.store.test_database import INI


def today():
    return day(time.time())


@pytest.fixture
async def url(postgres):
    return await postgres.new_database()


async def run(url, *statements):
    connection = await asyncpg.connect(url.replace("+asyncpg", ""))
    try:
        return [await connection.fetch(statement) for statement in statements][-1]
    finally:
        await connection.close()


async def parts(url):
    return [
        row[0]
        for row in await run(
            url, "SELECT inhrelid::regclass::text FROM pg_inherits WHERE inhparent = 'audit_lines'::regclass ORDER BY 1"
        )
    ]


async def written_on(url, sid, number):
    """Let a session's lines be of another day."""
    name, values = name_of(number), f"FOR VALUES FROM ({number}) TO ({number + 1})"
    await run(
        url,
        f"CREATE TABLE IF NOT EXISTS {name} PARTITION OF audit_lines {values}",
        f"UPDATE audit_lines SET day = {number} WHERE session_id = '{sid}'",
    )


@contextlib.asynccontextmanager
async def done_while_waited_for(url, statement, waiting):
    """Somebody else's change, which is not committed before the call waits for a lock."""
    connection = await asyncpg.connect(url.replace("+asyncpg", ""))
    try:
        async with connection.transaction():
            await connection.execute(statement)
            call = asyncio.create_task(waiting)
            while not (await run(url, "SELECT count(*) FROM pg_locks WHERE NOT granted"))[0][0]:
                assert not call.done()
                await asyncio.sleep(0.02)
        yield call
    finally:
        await connection.close()


async def test_there_are_parts_for_today_and_the_next_days(url):
    async with opened(url) as store, opened(url):
        sid = await added(store)
        await decided(store, sid, 1)
        await check_chain(store, sid)
    days = [name_of(today() + ahead) for ahead in range(AHEAD + 1)]
    assert await parts(url) == sorted([*days, partitions.BEFORE])
    assert (await run(url, f"SELECT count(*) FROM {days[0]}"))[0][0] == 2


async def test_what_was_there_before_stays_and_the_log_goes_on(url):
    database = connect(url)

    def before(connection):
        config = Config(INI)
        config.attributes["connection"] = connection
        command.upgrade(config, "0005")

    await database.write(before)
    later = {"audit_lines": "day", "sessions": "kept_bytes"}  # columns that the code of today writes
    await run(url, *(f"ALTER TABLE {table} ADD COLUMN {name} bigint DEFAULT 0" for table, name in later.items()))
    store = Store(url)
    sid = await added(store)
    await store.log(sid, note())
    await store.close()
    await run(url, *(f"ALTER TABLE {table} DROP COLUMN {name}" for table, name in later.items()))
    async with opened(url) as store:
        assert (await store.get(sid)).kept_bytes == 2 * 2048
        await store.log(sid, note())
        assert len(await check_chain(store, sid)) == 3
    assert (await run(url, f"SELECT count(*) FROM {partitions.BEFORE}"))[0][0] == 2
    assert partitions._day_of(partitions.BEFORE) == 0

    def back_and_forth(connection):
        config = Config(INI)
        config.attributes["connection"] = connection
        command.downgrade(config, "0005")
        command.upgrade(config, "head")

    await database.write(back_and_forth)
    await database.close()
    async with opened(url) as store:
        await store.log(sid, note())
        assert len(await check_chain(store, sid)) == 4


async def test_a_day_goes_as_a_whole_once_nobody_can_read_its_logs(url):
    now, old = time.time(), today() - 9
    async with opened(url) as store:
        ended, other, open_one = [await added(store, number) for number in range(3)]
        for sid in (ended, other):
            await store.end(sid, THE_END)
            await written_on(url, sid, old)
        await written_on(url, open_one, old)
        await run(url, f"UPDATE sessions SET touched_at = {now - 8 * DAY_S} WHERE session_id = '{ended}'")
        await store.purge(now - 7 * DAY_S)
        assert name_of(old) in await parts(url)  # two logs in it can be read
        assert await store.get(ended) is None
        assert await store.audit(ended, 0) == []
        assert len(await check_chain(store, other)) == 2
        await run(url, f"UPDATE sessions SET touched_at = {now - 8 * DAY_S} WHERE session_id = '{other}'")
        await store.end(open_one, THE_END)
        await run(
            url,
            f"UPDATE sessions SET touched_at = {now - 8 * DAY_S}",
            f"UPDATE audit_lines SET day = {old} WHERE session_id = '{open_one}'",
        )
        await store.purge(now - 7 * DAY_S)
        assert name_of(old) not in await parts(url)
        assert [await store.get(sid) for sid in (ended, other, open_one)] == [None] * 3
        with pytest.raises(SessionOver):
            await store.log(other, note())


async def test_many_sessions_of_a_day_go_a_few_at_a_time(url, monkeypatch):
    monkeypatch.setattr("service.keeping.purging.BARE_TOGETHER", 10)
    store, old, now = Store(url, limits=Limits(statement_s=0.5)), today() - 9, time.time()
    try:
        await store.start()
        for number in range(100):
            await store.end(await added(store, number), THE_END)
        await written_on(url, f"{0:032x}", old)
        await run(
            url,
            f"UPDATE audit_lines SET day = {old}",
            f"UPDATE sessions SET touched_at = {now - 9 * DAY_S}",
            "CREATE FUNCTION slow() RETURNS trigger AS 'BEGIN PERFORM pg_sleep(.01); RETURN OLD; END' LANGUAGE plpgsql",
            "CREATE TRIGGER slow BEFORE DELETE ON sessions FOR EACH ROW EXECUTE FUNCTION slow()",
        )
        await store.purge(now - 7 * DAY_S)
        assert await run(url, "SELECT * FROM sessions") == []
    finally:
        await store.close()


async def test_parts_go_where_logs_are_kept_for_less_than_a_day(url):
    now, old = time.time(), today() - 2
    async with opened(url) as store:
        sid = await added(store)
        await store.end(sid, THE_END)
        await written_on(url, sid, old)
        await run(url, f"UPDATE sessions SET touched_at = {now - 2 * DAY_S}")
        await store.purge(now - 3600)
        assert await store.get(sid) is None
        assert name_of(old) not in await parts(url)


async def test_a_line_that_is_written_while_its_day_is_about_to_go_is_kept(url, monkeypatch):
    monkeypatch.setattr(partitions, "LOCK_MS", 5000)
    old = today() - 9
    async with opened(url) as store:
        sid = await added(store)
        await written_on(url, "nobody", old)
        line = f"INSERT INTO audit_lines (session_id, seq, line, day) VALUES ('{sid}', 2, 'late', {old})"
        async with done_while_waited_for(url, line, store.purge(time.time() - 7 * DAY_S)) as purging:
            await purging
        assert await store.audit(sid, 1) == ["late"]


async def test_two_may_forget_the_same_days_at_once(url):
    async with opened(url) as one, opened(url) as other:
        for number in range(2, 6):
            await written_on(url, "nobody", today() - number)
        await asyncio.gather(*(store.purge(time.time() - DAY_S) for store in (one, other, one)))
        assert name_of(today() - 2) not in await parts(url)


async def test_readiness_makes_the_part_of_a_day_that_has_none(url):
    async with opened(url) as store:
        sid = await added(store)
        await run(url, "DELETE FROM audit_lines", f"DROP TABLE {name_of(today())}")  # as after a leap of the clock
        with pytest.raises(StoreUnavailable):
            await store.log(sid, note())
        await store.ping()
        await store.log(sid, note())


@pytest.mark.parametrize("days", [-400, 5, 400])
async def test_a_gateway_whose_clock_is_set_to_another_day_keeps_lines(url, days, monkeypatch):
    right = time.time
    async with opened(url) as store:
        sid = await added(store)
        monkeypatch.setattr(time, "time", lambda: right() + days * DAY_S)
        await decided(store, sid, 1)
        await added(store, 1)
        await store.ping()
        await check_chain(store, sid)
    monkeypatch.undo()
    assert name_of(today() + days) not in await parts(url)
    assert (await run(url, f"SELECT count(*) FROM {name_of(today())}"))[0][0] == 3


@pytest.mark.parametrize(
    ("mode", "made"),
    [("ACCESS SHARE", True), ("SHARE UPDATE EXCLUSIVE", False), ("ACCESS EXCLUSIVE", False)],
    ids=["backup", "vacuum", "change"],
)
async def test_a_day_begins_while_somebody_has_the_log_locked(url, mode, made, caplog):
    last = name_of(today() + AHEAD)
    other = await asyncpg.connect(url.replace("+asyncpg", ""))
    try:
        async with opened(url) as store:
            sid = await added(store)
            await run(url, f"DROP TABLE {last}")  # as if the day before had just ended
            async with other.transaction():
                await other.execute(f"LOCK TABLE ONLY audit_lines IN {mode} MODE")
                await store.make_ahead()
                assert not store._database.failed
                if mode != "ACCESS EXCLUSIVE":  # nobody reads or writes then
                    await store.ping()
                    await store.log(sid, note())
                async with opened(url):  # another process starts
                    pass
            assert (last in await parts(url)) is made
            assert ("no part of the audit log was made for the next days" in caplog.text) is not made
            await store.make_ahead()
            assert last in await parts(url)
    finally:
        await other.close()


async def test_without_a_part_for_today_there_is_no_start(url):
    async with opened(url):
        pass
    await run(url, f"DROP TABLE {name_of(today())}")
    other = await asyncpg.connect(url.replace("+asyncpg", ""))
    try:
        async with other.transaction():
            await other.execute("LOCK TABLE ONLY audit_lines IN SHARE UPDATE EXCLUSIVE MODE")
            with pytest.raises(StoreUnavailable):
                async with opened(url):
                    pass
    finally:
        await other.close()
    async with opened(url):
        pass


async def test_a_part_that_is_attached_is_as_the_others(url):
    async with opened(url) as store:
        sid = await added(store)
        keys = "SELECT count(*) FROM pg_constraint WHERE conrelid = '{}'::regclass AND contype = ANY('{{p,f}}'::char[])"
        for name in (name_of(today()), name_of(today() + AHEAD)):
            assert (await run(url, keys.format(name)))[0][0] == 2  # its key, and that of its session
        await run(url, f"DELETE FROM sessions WHERE session_id = '{sid}'")
        assert (await run(url, f"SELECT count(*) FROM {name_of(today())}"))[0][0] == 0


async def test_a_part_of_young_lines_is_kept_though_nobody_reads_it(url):
    async with opened(url) as store:
        sid = await added(store)
        await store.end(sid, THE_END)
        await run(url, f"UPDATE sessions SET touched_at = {time.time() - 3 * DAY_S}")
        await store.purge(time.time() - 2 * DAY_S)
        assert name_of(today()) in await parts(url)
        kept = await store.get(sid)
        assert kept.purging  # and goes with the day


async def test_who_stands_still_in_a_transaction_or_takes_too_long_is_hung_up_on(url):
    async with opened(url) as store:
        sid = await added(store)
    stuck = connect(url, Limits(connections=1, statement_s=0.3))
    try:
        with pytest.raises(StoreUnavailable):
            await stuck.write(lambda connection: connection.execute(text("SELECT pg_sleep(5)")))

        def dawdle(connection):
            connection.execute(text(f"SELECT 1 FROM sessions WHERE session_id = '{sid}' FOR UPDATE"))
            time.sleep(1.0)  # the whole process stands still
            connection.execute(text("SELECT 1"))

        with pytest.raises(StoreUnavailable):
            await stuck.write(dawdle)
    finally:
        await stuck.close()
    async with opened(url) as store:
        began = time.monotonic()
        await store.log(sid, note())
        assert time.monotonic() - began < 1.5


async def test_a_session_that_is_used_while_its_end_waits_for_its_row_goes_on(url):
    async with opened(url) as store:
        sid = await added(store)
        await run(url, "UPDATE sessions SET touched_at = 0")
        use = f"UPDATE sessions SET touched_at = {time.time()}"
        async with done_while_waited_for(url, use, store.end(sid, THE_END, time.time() - 60)) as ending:
            with pytest.raises(SessionInUse):
                await ending
        assert len(await check_chain(store, sid)) == 1


def connected(connection):
    """Connections at a moment when others wait for one."""
    connection.execute(text("SELECT pg_sleep(0.05)"))
    count = "SELECT count(*) FROM pg_stat_activity WHERE application_name = 'robosac' AND datname = current_database()"
    return connection.execute(text(count)).scalar()


async def test_a_process_takes_no_more_connections_than_it_may(url):
    database = connect(url, Limits(connections=2))
    try:
        counted = await all_of(*(database.write(connected) for _ in range(6)))
    finally:
        await database.close()
    assert max(counted) == 2
