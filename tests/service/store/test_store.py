"""What every store must do, on SQLite and PostgreSQL."""

import asyncio
import dataclasses
import json
import time

import pytest
import rfc8785
from sqlalchemy import text

from service.errors import (
    AuditFull,
    FrameDecided,
    Kind,
    Refused,
    SessionChanged,
    SessionInUse,
    SessionLost,
    SessionOver,
    TokenReplaced,
)
from service.keeping.once import CLOCKS_APART_S, MOST_PROOFS
from service.keeping.record import SessionRecord
from service.keeping.rows import ROW_BYTES
from service.keeping.store import PAGE, Store
from tests.service.store.conftest import (
    A_TEAM,
    A_TOKEN,
    THE_END,
    a_decision,
    a_session,
    added,
    all_of,
    check_chain,
    decided,
    note,
    opened,
)

LATER = time.time() + 3600
OF_SESSION = text("SELECT audit_seq, audit_head FROM sessions WHERE session_id = :sid")


async def test_a_session_comes_back_as_it_was_kept(store):
    record = a_session()
    await store.create(record, note(note="first"))
    kept = await store.get(record.session_id)
    (line,) = await check_chain(store, record.session_id)
    assert json.loads(line)["note"] == "first"
    assert kept == dataclasses.replace(record, audit_seq=1, audit_head=kept.audit_head, kept_bytes=len(line))
    assert store.seen(record.session_id) == kept
    assert await store.count() == 1


@pytest.mark.parametrize("sid", ["f" * 32, "", "x' OR '1'='1", "\x00", "\udcff", "ä"])
async def test_a_session_that_is_not_there(store, sid):
    await added(store)
    assert await store.get(sid) is None
    assert store.seen(sid) is None


async def test_a_decision_changes_state_seed_frame_and_log_together(store):
    sid = await added(store)
    await store.decide(a_session(), a_decision(2**53 - 1, trusted=["b"]), "cd" * 32, b"\x00messages\xff")
    kept = await store.get(sid)
    assert (kept.last_frame, kept.frames_answered, kept.state) == (2**53 - 1, 1, {"trusted": ["b"]})
    assert (kept.seed, kept.revision) == ("cd" * 32, 1)
    assert len(await check_chain(store, sid)) == 2
    assert await store.messages(sid, 2**53 - 1) == b"\x00messages\xff"
    assert await store.messages(sid, 1) is None


async def test_a_frame_is_decided_once_and_frames_increase(store):
    sid = await added(store)
    await decided(store, sid, 5)
    for frame in (5, 4):
        with pytest.raises(FrameDecided):
            await decided(store, sid, frame)
    await decided(store, sid, 6)
    assert len(await check_chain(store, sid)) == 3


async def test_of_decisions_at_once_one_is_kept(store):
    sid = await added(store)
    calls = [store.decide(a_session(), a_decision(frame), f"{frame:064x}") for frame in (7, 7, 7, 8, 9)]
    outcomes = await all_of(*calls)
    assert sum(isinstance(outcome, SessionRecord) for outcome in outcomes) == 1
    assert {type(outcome) for outcome in outcomes} <= {SessionRecord, FrameDecided, SessionChanged}
    assert (await store.get(sid)).frames_answered == 1
    assert len(await check_chain(store, sid)) == 2


async def test_fifty_logs_at_once_make_one_chain(store):
    sid, other = await added(store), await added(store, 1)
    outcomes = await all_of(
        *(store.log(sid, note(n=n)) for n in range(50)),
        decided(store, sid, 3),
        *(store.log(other, note(n=n)) for n in range(5)),
    )
    assert set(outcomes) == {None}
    lines = [json.loads(line) for line in await check_chain(store, sid)]
    assert {line["n"] for line in lines if line["event"] == "note"} == set(range(50))
    assert len(lines) == 52
    assert len(await check_chain(store, other)) == 6
    assert (await store.audit(sid, 50)) == (await store.audit(sid, 0))[50:]
    assert await store.audit(sid, 99) == []


async def test_an_exception_inside_a_transaction_leaves_nothing(store):
    sid = await added(store)
    before, lines = await store.get(sid), await store.audit(sid, 0)
    outcomes = await all_of(
        store.decide(a_session(), a_decision(), "ef" * 32, "no bytes"),
        store.decide(a_session(), a_decision(bad=object()), "ef" * 32),
        store.log(sid, note(value=float("nan"))),
    )
    assert all(isinstance(outcome, Exception) for outcome in outcomes)
    assert await store.get(sid) == before
    assert await store.audit(sid, 0) == lines
    with pytest.raises(rfc8785.FloatDomainError):
        await store.create(a_session(1), note(value=float("nan")))
    assert await store.get(a_session(1).session_id) is None


async def test_what_fails_takes_nothing_else_with_it(store):
    sid = await added(store)
    bad = note(value=float("inf"))
    outcomes = await all_of(*(store.log(sid, bad if n % 3 == 0 else note()) for n in range(30)))
    assert [isinstance(outcome, Exception) for outcome in outcomes] == [n % 3 == 0 for n in range(30)]
    assert len(await check_chain(store, sid)) == 1 + 20


async def test_a_change_worked_out_from_an_older_session_is_refused(store):
    sid = await added(store)
    await store.log(sid, note())
    assert (await store.get(sid)).revision == 0
    await store.renew_token(sid, "t1", "t9", A_TOKEN)
    before, tokens = a_session(), {"ego": "t0", "a": "t1"}
    for change in (store.decide(before, a_decision(), "00" * 32), store.change_team(before, A_TEAM, tokens)):
        with pytest.raises(SessionChanged):
            await change
    await store.change_team(a_session(revision=1), A_TEAM, tokens)
    kept = await store.get(sid)
    assert (kept.teammates, kept.token_ids, kept.public_keys) == (("a",), tokens, {})
    assert kept.state == {"trusted": []}
    assert len(await check_chain(store, sid)) == 4


async def test_a_proof_is_new_once_for_its_vehicle_until_it_is_forgotten(store):
    sid, other = await added(store), await added(store, 1)
    outcomes = await all_of(*(store.use_proof(sid, "a", "p", 80.0, 0.0) for _ in range(5)))
    assert sorted(outcomes) == [False] * 4 + [True]
    assert await store.use_proof(sid, "b", "p", 80.0, 0.0)
    assert await store.use_proof(other, "a", "p", 80.0, 0.0)
    assert not await store.use_proof(sid, "a", "p", 80.0, 80.0)
    assert not await store.use_proof(sid, "a", "p", 80.0, 80.0 + CLOCKS_APART_S)  # another's clock may be behind
    now, until = 81.0 + CLOCKS_APART_S, 200.0 + CLOCKS_APART_S
    assert await store.use_proof(sid, "a", "p", until, now)
    for n in range(MOST_PROOFS - 1):
        assert await store.use_proof(sid, "a", f"{n}", until, now)
    with pytest.raises(Refused, match="256"):
        await store.use_proof(sid, "a", "one more", until, now)
    assert await store.use_proof(sid, "a", "later", until + 80.0, until + 1.0)  # those are remembered, and do not count
    assert not await store.use_proof(sid, "a", "0", until, until + 1.0)
    await store.end(sid, THE_END)
    await store.purge(LATER)
    assert await store.get(sid) is None


async def test_one_token_is_renewed_and_the_others_stay(store):
    sid = await added(store)
    await store.renew_token(sid, "t1", "new", A_TOKEN)
    with pytest.raises(TokenReplaced):
        await store.renew_token(sid, "t1", "newer", A_TOKEN)
    assert (await store.get(sid)).token_ids == {"ego": "t0", "a": "new", "b": "t2"}


async def test_nothing_is_added_to_a_session_that_is_over(store):
    sid = await added(store)
    await store.end(sid, THE_END)
    for record in (await store.get(sid), a_session(99)):
        calls = (
            store.decide(record, a_decision(), "00" * 32),
            store.log(record.session_id, note()),
            store.renew_token(record.session_id, "t1", "t", A_TOKEN),
            store.change_team(record, A_TEAM, {}),
            store.end(record.session_id, THE_END),
        )
        for call in calls:
            with pytest.raises(SessionOver):
                await call
    assert (await store.get(sid)).ended_at == "2025-01-01T01:00:00Z"
    assert len(await check_chain(store, sid)) == 2
    assert await store.count() == 0


async def test_old_messages_are_forgotten(store):
    sid, other = await added(store), await added(store, 1)
    for number in range(2):
        for frame in range(4):
            record = a_session(number, revision=frame)
            kept = 0 if number else 2
            await store.decide(record, a_decision(frame), "00" * 32, bytes([frame]), keep_frames=kept)
    assert [await store.messages(sid, frame) for frame in range(4)] == [None, None, b"\x02", b"\x03"]
    assert await store.messages(other, 0) == b"\x00"


async def test_a_session_that_was_used_since_is_not_ended_for_being_idle(store):
    sid = await added(store)
    with pytest.raises(SessionInUse):
        await store.end(sid, THE_END, time.time() - 60)
    await store.log(sid, note())
    await store.end(sid, THE_END, LATER)
    assert len(await check_chain(store, sid)) == 3


async def test_of_processes_that_open_sessions_of_a_key_at_once_none_opens_too_many(shared_url):
    async with opened(shared_url) as one, opened(shared_url) as other:
        await added(one, 9)
        new = [a_session(number, key_id="key") for number in range(8)]
        opening = (store.create(record, note(), 3) for record, store in zip(new, 4 * [one, other], strict=True))
        refused = [outcome for outcome in await all_of(*opening) if isinstance(outcome, Exception)]
        assert [why.kind for why in refused] == [Kind.TOO_MANY_SESSIONS] * 5
        assert await one.count("key") == 3
        await other.create(a_session(8, key_id="another"), note(), 3)


async def test_idle_sessions_are_found_and_only_ended_ones_are_purged(store):
    idle, ended = await added(store), await added(store, 1)
    await store.decide(a_session(1), a_decision(0), "00" * 32, b"kept")
    await store.end(ended, THE_END)
    assert [await store.unused_since(moment) for moment in (LATER, time.time() - 60)] == [[idle], []]
    await store.touch({idle: LATER, ended: LATER})
    assert await store.unused_since(LATER) == []
    await store.purge(time.time() - 60)
    assert await store.get(ended) is not None
    await store.purge(LATER)
    assert (await store.get(ended), await store.audit(ended, 0), await store.messages(ended, 0)) == (None, [], None)
    assert store.seen(ended) is None
    assert len(await check_chain(store, idle)) == 1


async def test_a_secret_is_made_once(store):
    made = iter(["first", "second", "other"])
    assert [await store.secret("key", lambda: next(made)) for _ in range(2)] == ["first", "first"]
    assert await store.secret("another", lambda: "x") == "x"


async def test_everything_is_there_when_the_database_is_opened_again(shared_url):
    async with opened(shared_url) as store:
        sid = await added(store)
        await decided(store, sid, 4, trusted=["b"])
        secret = await store.secret("key", lambda: "one")
        before, lines = await store.get(sid), await store.audit(sid, 0)
    async with opened(shared_url) as store:
        assert store.seen(sid) is None
        assert await store.get(sid) == before
        assert await store.audit(sid, 0) == lines
        assert await store.secret("key", lambda: "two") == secret
        await decided(store, sid, 5)
        assert len(await check_chain(store, sid)) == 3


async def test_two_stores_on_one_database_never_fork_a_chain_or_decide_twice(shared_url):
    async with opened(shared_url) as one, opened(shared_url) as two:
        sid = await added(one)
        assert (await two.get(sid)).revision == 0
        outcomes = await all_of(*(store.log(sid, note()) for _ in range(15) for store in (one, two)))
        assert set(outcomes) == {None}
        calls = [store.decide(a_session(), a_decision(), "00" * 32) for store in (one, two)]
        assert sum(isinstance(outcome, SessionRecord) for outcome in await all_of(*calls)) == 1
        assert len(await check_chain(one, sid)) == len(await check_chain(two, sid)) == 32


async def test_a_store_learns_of_a_conflict_what_the_other_did(shared_url):
    async with opened(shared_url) as one, opened(shared_url) as two:
        sid = await added(one)
        await two.renew_token(sid, "t1", "t9", A_TOKEN)
        assert one.seen(sid).revision == 0
        with pytest.raises(SessionChanged):
            await one.decide(a_session(), a_decision(), "00" * 32)
        assert one.seen(sid) == await two.get(sid)


async def test_many_sessions_are_remembered_but_not_all():
    store = Store("sqlite://", remembered=3)
    await store.start()
    sids = [await added(store, number) for number in range(5)]
    assert [store.seen(sid) is None for sid in sids] == [True, True, False, False, False]
    assert (await store.get(sids[0])).session_id == sids[0]
    await store.close()


async def test_a_session_whose_records_the_database_lost_takes_no_others(store, caplog):
    """As a standby may have lost them that is promoted, or a backup that was put back."""
    sid, other = await added(store), await added(store, 1)
    row = await store._database.read(lambda connection: connection.execute(OF_SESSION, {"sid": sid}).one())
    await store.renew_token(sid, "t1", "t9", A_TOKEN)
    promised = store.seen(sid)
    undone = text("UPDATE sessions SET revision = 0, audit_seq = :seq, audit_head = :head WHERE session_id = :sid")
    other_line = text("UPDATE audit_lines SET line = 'another' WHERE session_id = :sid AND seq > :seq - 2")
    for head, seq in ((row.audit_head, 1), ("f" * 64, 2), ("e" * 64, 3)):
        changed = {"sid": sid, "seq": seq, "head": head}
        await store._database.write(lambda connection, changed=changed: connection.execute(undone, changed))
        if seq == 3:  # another process went on, with another second record
            at = {"sid": sid, "seq": seq}
            await store._database.write(lambda connection, at=at: connection.execute(other_line, at))
        assert (await store.get(sid)).audit_head == head
        assert store.seen(sid) == promised
        for _ in range(2):
            with pytest.raises(SessionLost):
                await store.log(sid, A_TOKEN)
        assert f"ends with record {seq}, and record 2 was kept before" in caplog.text
    assert len(await store.audit(sid, 0)) == 2
    await store.log(other, A_TOKEN)


async def test_a_log_is_read_in_pages_and_purged_in_short_transactions(store):
    sid, other = await added(store), await added(store, 1)
    await all_of(*(store.log(sid, note(n=n)) for n in range(2 * PAGE)))
    pages, after = [], 0
    while page := await store.audit(sid, after):
        pages.append(page)
        after += len(page)
    assert [len(page) for page in pages] == [PAGE, PAGE, 1]
    await store.end(sid, THE_END)
    purging = asyncio.create_task(store.purge(time.time() + 1))
    while not purging.done():
        record = await store.get(sid)
        assert record is None or record.purging or len(await store.audit(sid, 0)) == PAGE
    await purging
    assert (await store.get(sid), await store.audit(sid, 0)) == (None, [])
    assert len(await store.audit(other, 0)) == 1


async def test_it_is_known_what_is_kept_for_each_key(store):
    open_one, ended, of_other = [await added(store, n, key_id=key) for n, key in enumerate("aab")]
    await decided(store, open_one, 1)
    for frame, messages in enumerate([b"m" * 1000, b"m" * 3000]):
        seed, record = f"{frame:064x}", await store.get(ended)
        await store.decide(record, a_decision(frame), seed, messages, keep_frames=1)
    open_ones = (await store.kept_bytes())["a"]
    memory = row_bytes(await store.get(ended))
    await store.end(ended, THE_END)
    lines = {sid: sum(len(line.encode()) for line in await store.audit(sid, 0)) for sid in (open_one, ended, of_other)}
    rows = {sid: row_bytes(await store.get(sid)) for sid in lines}
    kept = {sid: lines[sid] + rows[sid] for sid in lines}
    assert await store.kept_bytes() == {"a": kept[open_one] + kept[ended] + 3000, "b": kept[of_other]}
    (*_, last) = await store.audit(ended, 0)
    assert open_ones == kept[open_one] + lines[ended] - len(last.encode()) + memory + 3000  # before it was ended
    assert (await store.get(open_one)).kept_bytes == lines[open_one]
    await store.purge(time.time() + 1)
    assert await store.kept_bytes() == {"a": kept[open_one], "b": kept[of_other]}


def row_bytes(record):
    """Bytes of what can be long in a session's row, and of the rest of it."""
    fields = (record.teammates, record.defense, record.token_ids, record.public_keys, record.state)
    return ROW_BYTES + sum(len(json.dumps(field)) for field in fields)


async def test_what_a_defence_remembers_is_kept_until_its_session_ends(store):
    sid = await added(store, 0, key_id="a", state={"memory": "x" * 100_000})
    assert (await store.kept_bytes())["a"] > 100_000
    await decided(store, sid, 1, memory="x" * 300_000)
    assert (await store.kept_bytes())["a"] > 300_000
    opened = (await store.get(sid)).defense
    await store.end(sid, THE_END)
    ended = await store.get(sid)
    assert (ended.state, ended.defense, ended.token_ids) == ({}, opened, {"ego": "t0", "a": "t1", "b": "t2"})
    assert ended.kept_bytes == (await store.kept_bytes())["a"]
    await check_chain(store, sid)


async def test_a_full_log_takes_only_the_end(url):
    store = Store(url, most_records=3)
    await store.start()
    sid = await added(store)
    await decided(store, sid, 1)
    await store.log(sid, note())
    for refused in (store.log(sid, note()), decided(store, sid, 2)):
        with pytest.raises(AuditFull, match="ROBOSAC_AUDIT_MAX_RECORDS"):
            await refused
    assert (await store.get(sid)).last_frame == 1
    await store.end(sid, THE_END)
    lines = await check_chain(store, sid)
    assert [json.loads(line)["event"] for line in lines][-1] == "session_ended"
    await store.close()
