"""The journal beside a SQLite file holds what was acknowledged last."""

import sqlite3
from contextlib import closing

import pytest

from service.errors import SessionLost, StoreUnavailable
from tests.service.store.conftest import added, check_chain, decided, opened


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
