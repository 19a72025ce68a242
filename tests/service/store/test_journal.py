"""The journal beside a SQLite file holds what was acknowledged last."""

import sqlite3
from contextlib import closing

import pytest

from service.errors import SessionLost, StoreUnavailable
from tests.service.store.conftest import A_TOKEN, added, check_chain, decided, opened


@pytest.mark.parametrize("put_in_its_place", [None, b"", b"something else"])
async def test_where_the_journal_was_removed_nothing_more_is_acknowledged_and_nothing_is_lost(
    put_in_its_place, tmp_path
):
    """Somebody made room, or put a copy back: what was written from then on would be lost with the process, and what
    another process writes meanwhile would garble the file.
    """
    path = tmp_path / "robosac.db"
    async with opened(f"sqlite:///{path}") as store:
        sid = await added(store)
        await decided(store, sid, 1)
        journal = tmp_path / "robosac.db-wal"
        journal.unlink()
        if put_in_its_place is not None:
            journal.write_bytes(put_in_its_place)
        for _ in range(2):
            with pytest.raises(StoreUnavailable):
                await decided(store, sid, 2)
            with pytest.raises(StoreUnavailable):
                await store.ping()
    async with opened(f"sqlite:///{path}") as store:
        assert len(await check_chain(store, sid)) == 2
        await decided(store, sid, 2)


async def test_where_another_journal_is_in_its_place_the_file_is_left_alone(tmp_path):
    """Whoever made it writes to the file."""
    path = tmp_path / "robosac.db"
    async with opened(f"sqlite:///{path}") as store:
        sid = await added(store)
        (tmp_path / "robosac.db-shm").unlink()
        (tmp_path / "robosac.db-wal").unlink()
        (tmp_path / "robosac.db-wal").write_bytes(b"")
        before = path.stat().st_mtime_ns
        with pytest.raises(StoreUnavailable):
            await store.log(sid, A_TOKEN)
        assert path.stat().st_mtime_ns == before


@pytest.mark.parametrize("removed", [("-wal", "-shm"), ("-wal",), ("-shm",)])
@pytest.mark.parametrize("noticed", ["by both", "by the other", "by nobody"])
async def test_what_a_removed_journal_held_is_there_for_who_starts_while_another_still_runs(noticed, removed, tmp_path):
    """Processes are restarted one after the other; SQLite would write it to the file with the last of them only."""
    path = tmp_path / "robosac.db"
    url = f"sqlite:///{path}"
    async with opened(url) as running:
        sid = await added(running)
        async with opened(url) as restarted:
            await decided(restarted, sid, 1)
            await running.get(sid)
            for end in removed:
                path.with_name(path.name + end).unlink()
            if noticed == "by both":
                with pytest.raises(StoreUnavailable):
                    await decided(restarted, sid, 2)
        if noticed != "by nobody":
            with pytest.raises(StoreUnavailable):
                await running.get(sid)
        path.with_name("robosac.db-wal").unlink(missing_ok=True)
        path.with_name("robosac.db-shm").unlink(missing_ok=True)
        async with opened(url) as restarted:
            await decided(restarted, sid, 2)
            with pytest.raises(StoreUnavailable):
                await decided(running, sid, 3)
            await decided(restarted, sid, 3)
            assert len(await check_chain(restarted, sid)) == 4
    async with opened(url) as store:
        assert len(await check_chain(store, sid)) == 4
        with closing(sqlite3.connect(path)) as live:
            assert live.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


async def test_a_backup_that_is_put_into_the_open_file_forks_no_log(tmp_path):
    """SQLite's own way back keeps the files where they are."""
    path, copy = tmp_path / "robosac.db", tmp_path / "copy.db"
    async with opened(f"sqlite:///{path}") as store:
        sid = await added(store)
        await decided(store, sid, 1)
        with closing(sqlite3.connect(path)) as live, closing(sqlite3.connect(copy)) as kept:
            live.backup(kept)
        await decided(store, sid, 2)
        with closing(sqlite3.connect(path)) as live, closing(sqlite3.connect(copy)) as kept:
            kept.backup(live)
        for _ in range(2):
            with pytest.raises(SessionLost):
                await decided(store, sid, 3)
        assert len(await check_chain(store, sid)) == 2
        await decided(store, await added(store, 1), 1)


async def test_a_session_goes_on_nowhere_that_knows_of_what_was_lost(tmp_path, caplog):
    """Another process that does not may have added other records in the meantime."""
    path, url = tmp_path / "robosac.db", f"sqlite:///{tmp_path}/robosac.db"
    empty, copy = tmp_path / "empty.db", tmp_path / "copy.db"

    def copied(source, target):
        with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as other:
            one.backup(other)

    async with opened(url) as store:
        copied(path, empty)
        sid = await added(store)
        await decided(store, sid, 1)
        copied(path, copy)
        await decided(store, sid, 2)
        copied(empty, path)
        for _ in range(2):
            assert await store.get(sid) is None
        assert f"session {sid} is gone" in caplog.text
        copied(copy, path)
        with pytest.raises(SessionLost):
            await decided(store, sid, 3)
        async with opened(url) as other:
            for frame in (2, 3, 4):
                await decided(other, sid, frame)
        for _ in range(2):
            assert (await store.get(sid)).last_frame == 4
            with pytest.raises(SessionLost):
                await decided(store, sid, 5)
            with pytest.raises(SessionLost):
                await store.log(sid, A_TOKEN)
        assert len(await check_chain(store, sid)) == 5
