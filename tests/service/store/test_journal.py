"""The journal beside a SQLite file holds what was acknowledged last."""

import pytest

from service.errors import StoreUnavailable
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
