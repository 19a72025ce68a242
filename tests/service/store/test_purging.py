"""What ended sessions leave, and how it goes."""

import time

from sqlalchemy import text

from tests.service.store.conftest import THE_END, added, all_of, note

SESSIONS = 60


async def left_in(store, table):
    return await store._database.read(lambda connection: connection.execute(text(f"SELECT * FROM {table}")).all())


async def test_many_sessions_go_in_few_transactions(store, monkeypatch):
    sids = [await added(store, number) for number in range(SESSIONS)]
    await all_of(*(store.log(sid, note(n=n)) for sid in sids[:3] for n in range(200)))
    await all_of(*(store.end(sid, THE_END) for sid in sids[1:]))
    written, write = [], store._database.write

    async def counted(work, *more):
        written.append(work)
        return await write(work, *more)

    monkeypatch.setattr(store._database, "write", counted)
    await store.purge(time.time() + 1)
    assert len(written) < SESSIONS / 2
    assert {row.session_id for row in await left_in(store, "sessions")} == {sids[0]}
    assert {row.session_id for row in await left_in(store, "audit_lines")} == {sids[0]}
    assert len(await store.audit(sids[0], 0, 300)) == 201


async def test_of_a_session_that_has_ended_no_proof_is_kept(store):
    ended, other = await added(store), await added(store, 1)
    for sid in (ended, other):
        assert await store.use_proof(sid, "a", "p", time.time() + 80, time.time())
    await store.end(ended, THE_END)
    assert [row.session_id for row in await left_in(store, "used_proofs")] == [other]
