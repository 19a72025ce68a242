import asyncio
import contextlib
import json
import sqlite3

import pytest
from sqlalchemy import delete, text, update

from clients.errors import AccessDenied, SessionNotFound
from robosac.audit import verify
from robosac.audit.events import TokenRenewed
from service.errors import SessionOver, StoreUnavailable
from service.keeping.store import PAGE
from service.keeping.tables import audit_lines, sessions
from service.sessions.idle import Idle
from service.sessions.pages import FIRST_PAGE, PAGE_BYTES
from tests.service.conftest import EGO, TEAM, problem, serve, until


async def test_the_detectors_say_what_to_send(served, detector):
    (entry,) = await served.client.detectors()
    assert entry["name"] == "intersection-mean"
    assert entry["tensors"]["ego"] == entry["tensors"]["teammate"]
    assert entry["tensors"]["ego"]["features"] == {"dtype": "float16", "shape": [64, 32, 32]}
    assert entry["narrower"] == {"features": ["int8"]}
    assert entry["area_m"] == [-32, -32, 32, 32]
    assert entry["weights_digest"] == detector.info.weights_digest
    assert entry["device"] == "cpu"


async def test_a_session_answers_with_everything_its_vehicles_need(served):
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
    assert set(session.teammate_tokens) == set(TEAM)
    assert len({session.ego_token, *session.teammate_tokens.values()}) == 6
    assert session.detector["name"] == "intersection-mean"
    assert session.defense["collaborators"] == 3
    assert session.defense["consensus_threshold"] == 0.3


async def test_a_log_that_is_purged_while_it_is_read_never_looks_whole(served):
    session, store = await served.open(), served.gateway.store
    note = TokenRenewed(vehicle_id=EGO, expires_at="2026-01-01T00:00:00Z")
    await asyncio.gather(*(store.log(session.session_id, note) for _ in range(3 * PAGE)))
    await served.ego(session).close()
    pages = await served.gateway.sessions.audit_log(session.session_id, session.ego_token, 0, 10**6)
    assert (await anext(pages)).count("\n") == FIRST_PAGE
    beginning = delete(audit_lines).where(audit_lines.c.seq <= FIRST_PAGE + 9)
    nobody_may = update(sessions).values(token_ids="{}")
    await store._database.write(lambda connection: [connection.execute(step) for step in (nobody_may, beginning)])
    with pytest.raises(SessionOver, match="purged"):
        await anext(pages)


async def test_a_log_of_which_lines_are_gone_meanwhile_breaks_off_without_a_traceback(served, monkeypatch, caplog):
    session, sent = await served.open(), []
    for _ in range(2 * FIRST_PAGE):
        note = TokenRenewed(vehicle_id=EGO, expires_at="2026-01-01T00:00:00Z")
        await served.gateway.store.log(session.session_id, note)
    read = served.gateway.store.audit

    async def gone(sid, after, limit):
        return [] if after else await read(sid, after, limit)

    async def receive():
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message):
        sent.append(message)

    monkeypatch.setattr(served.gateway.store, "audit", gone)
    path = f"/v1/sessions/{session.session_id}/audit"
    headers = [(b"host", b"gateway"), (b"authorization", f"Bearer {session.ego_token}".encode())]
    asgi = {"type": "http", "asgi": {"version": "3.0", "spec_version": "2.4"}, "http_version": "1.1"}
    asked = {"method": "GET", "scheme": "http", "path": path, "raw_path": path.encode(), "query_string": b""}
    where = {"headers": headers, "client": ("127.0.0.1", 1), "server": ("gateway", 80), "root_path": ""}
    await served.http._transport.app({**asgi, **asked, **where}, receive, send)
    assert [message.get("more_body") for message in sent] == [None, True]
    assert "a log broke off" in caplog.text
    assert "unhandled" not in caplog.text


async def test_pages_of_a_log_are_as_large_as_their_lines_allow(served):
    session, store = await served.open(), served.gateway.store
    for length in [10] * 600 + [50_000] * 20 + [10] * 600:
        await store.log(session.session_id, TokenRenewed(vehicle_id="v" * length, expires_at="2026-01-01T00:00:00Z"))
    pages = await served.gateway.sessions.audit_log(session.session_id, session.ego_token, 0, 10**6)
    sizes = [len(page) async for page in pages]
    assert max(sizes) < PAGE_BYTES + PAGE
    assert len(sizes) < 40


async def test_of_a_session_that_ended_nothing_long_is_kept_in_memory(served):
    session, store = await served.open(), served.gateway.store
    assert store.seen(session.session_id).state
    await served.ego(session).close()
    await served.ego(session).audit()
    kept = store.seen(session.session_id)
    assert (kept.state, kept.defense) == ({}, {})


async def test_what_was_read_before_the_end_does_not_bring_a_session_back(served, monkeypatch):
    session, store = await served.open(), served.gateway.store
    read, go_on, database = asyncio.Event(), asyncio.Event(), store._database

    async def slowly(work, real=database.read):
        row = await real(work)
        read.set()
        await go_on.wait()
        return row

    with monkeypatch.context() as patched:
        patched.setattr(database, "read", slowly)
        late = asyncio.create_task(store.get(session.session_id))
        await read.wait()
    await served.ego(session).close()
    go_on.set()
    assert (await late).ended_at is not None
    assert store.seen(session.session_id).ended_at is not None


async def test_settings_are_read_once(served, monkeypatch):
    def unexpected(*_):
        raise AssertionError

    monkeypatch.setattr("service.sessions.sessions.read_settings", unexpected)
    session = await served.open(defense={"kind": "conformal", "calibration": [0.25, 0.5]})
    assert (await served.ego(session).state())["defense"]["calibration"] == [0.25, 0.5]


async def test_state_and_end(served, good_frame):
    session = await served.open()
    ego = served.ego(session)
    before = await ego.state()
    assert (before["ego_id"], before["teammates"], before["last_frame"]) == (EGO, list(TEAM), None)
    await served.post(session, "frames", good_frame(4))
    after = await ego.state()
    assert (after["last_frame"], after["frames_answered"]) == (4, 1)
    assert after["audit_seq"] == 2
    await ego.close()
    with pytest.raises(SessionNotFound):
        await ego.state()


@pytest.mark.parametrize(
    ("request_", "field", "hint"),
    [
        ({}, "ego_id", "is missing"),
        ({"ego_id": "a"}, "teammates", "is missing"),
        ({"ego_id": "a b", "teammates": []}, "ego_id", "pattern"),
        ({"ego_id": "../etc", "teammates": []}, "ego_id", "pattern"),
        ({"ego_id": "a\n", "teammates": []}, "ego_id", "pattern"),
        ({"ego_id": "a", "teammates": ["b", "b"]}, "teammates", "distinct"),
        ({"ego_id": "a", "teammates": ["b", "a"]}, "teammates", "own teammate"),
        ({"ego_id": "a", "teammates": ["b"], "surprise": 1}, "surprise", "no such field"),
        ({"ego_id": "a", "teammates": ["b"], "latency_budget_ms": 0}, "latency_budget_ms", "greater than 0"),
        ({"ego_id": "a", "teammates": ["b"], "latency_budget_ms": 50, "gather_ms": 51}, "gather_ms", "50 ms"),
        ({"ego_id": "a", "teammates": ["b"], "detector": "nonesuch"}, "detector", "intersection-mean"),
        ({"ego_id": "a", "teammates": ["b"], "defense": {"kind": "magic"}}, "defense.kind", "sample_consensus"),
        (
            {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "sample_consensus", "attacker_ratio": 1.0}},
            "defense.attacker_ratio",
            "less than 1",
        ),
        (
            {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "sample_consensus", "attacker_ratio": 0}},
            "defense.attacker_ratio",
            "greater",
        ),
        (
            {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "sample_consensus", "sampling_budget": 0}},
            "defense.sampling_budget",
            "greater",
        ),
        (
            {
                "ego_id": "a",
                "teammates": ["b", "c"],
                "defense": {"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3},
            },
            "defense",
            "at most 1 can",
        ),
        (
            {"ego_id": "a", "teammates": list("bcdef"), "defense": {"kind": "sample_consensus", "collaborators": 5}},
            "defense",
            "at most 4",
        ),
        ({"ego_id": "a", "teammates": [f"v{i}" for i in range(64)]}, "teammates", "at most 63"),
    ],
)
async def test_a_bad_request_is_told_what_is_wrong_with_which_field(served, request_, field, hint):
    response = await served.http.post("/v1/sessions", json=request_)
    assert response.status_code == 422
    fields = problem(response, 422, response.json()["type"].rsplit(":", 1)[-1])
    assert fields["field"] == field
    assert hint in fields["detail"]


async def test_bodies_that_are_no_json_are_refused(served):
    response = await served.http.post("/v1/sessions", content=b"{", headers={"Content-Type": "application/json"})
    problem(response, 400, "malformed-json")


async def test_only_the_ego_may_look_inside_and_end_the_session(served):
    session = await served.open()
    spy = served.teammate(session, "car-2")
    for call in (spy.state, spy.audit, spy.close):
        with pytest.raises(AccessDenied) as caught:
            await call()
        assert caught.value.status == 403
    assert (await served.ego(session).state())["session_id"] == session.session_id


@pytest.mark.parametrize("authorization", [None, "Bearer", "Bearer wrong", "Basic abc", "Bearer \xff"])
async def test_without_a_token_of_the_session_nothing_is_told(served, authorization):
    session = await served.open()
    headers = {} if authorization is None else {"Authorization": authorization.encode("latin-1")}
    response = await served.http.get(f"/v1/sessions/{session.session_id}", headers=headers)
    problem(response, 401, "unauthenticated")
    assert response.headers["www-authenticate"] == "Bearer"


async def test_tokens_of_one_session_are_worth_nothing_in_another(served):
    one, other = await served.open(), await served.open()
    with pytest.raises(AccessDenied):
        await served.client.vehicle(one.session_id, EGO, other.ego_token).state()


async def test_unknown_sessions_and_paths_are_problems_too(served):
    problem(await served.http.get("/v1/sessions/nope", headers={"Authorization": "Bearer x"}), 404, "unknown-session")
    problem(await served.http.get("/v1/nope"), 404, "not-found")
    problem(await served.http.put("/v1/sessions"), 405, "method-not-allowed")


async def test_the_number_of_sessions_is_bounded():
    async with serve(max_sessions=2) as served:
        first = await served.open()
        await served.open()
        response = await served.http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"]})
        problem(response, 503, "too-many-sessions")
        assert response.headers["retry-after"]
        await served.ego(first).close()
        await served.open()


async def test_a_session_does_not_expire_under_a_waiting_ego(messages):
    async with serve(session_idle_s=0.1) as served:
        session = await served.open(gather_ms=500)
        answer = await served.ego(session).ask(0, messages["car-1"])
        assert answer.source == "ego_only"


async def test_idle_sessions_expire():
    async with serve(session_idle_s=0.6) as served:
        idle, busy = await served.open(), await served.open()
        for _ in range(20):
            await asyncio.sleep(0.1)
            await served.ego(busy).state()
        with pytest.raises(SessionNotFound):
            await served.ego(idle).state()


async def test_a_session_that_cannot_be_ended_keeps_no_other_from_it_nor_logs_from_being_purged(monkeypatch):
    async with serve(session_idle_s=1.0, audit_retention_s=0.01) as served:
        store = served.gateway.store
        over, *idle = [await served.open() for _ in range(3)]
        await served.ego(over).close()
        damaged, done, end = idle[0].session_id, [], store.end

        async def ended(sid, event, _):
            if sid == damaged:
                raise StoreUnavailable
            await end(sid, event)
            done.append(sid)

        async def fails(*_):
            raise StoreUnavailable

        monkeypatch.setattr(store, "end", ended)
        monkeypatch.setattr(store, "kept_bytes", fails)
        monkeypatch.setattr(Idle, "unused", lambda _: asyncio.sleep(0, [session.session_id for session in idle]))
        monkeypatch.setattr(Idle, "is_unused_here", lambda *_: True)
        await asyncio.sleep(0.02)
        await served.gateway.sessions.sweep()
        assert done == [idle[1].session_id]
        assert await store.get(over.session_id) is None


async def test_a_session_whose_records_the_database_lost_is_not_said_to_be_closed(monkeypatch, messages, caplog):
    columns = "revision = {0.revision}, audit_seq = {0.audit_seq}, audit_head = '{0.audit_head}'"
    async with serve(session_idle_s=1.0) as served:
        session, store = await served.open(defense={"kind": "none"}), served.gateway.store
        before = await store.get(session.session_id)
        await served.ego(session).ask(0, messages["car-1"])
        undone = text(f"UPDATE sessions SET {columns.format(before)}")
        await store._database.write(lambda connection: connection.execute(undone))
        for _ in range(2):
            with pytest.raises(SessionNotFound, match="the database lost what was promised"):
                await served.ego(session).close()
        monkeypatch.setattr(Idle, "unused", lambda _: asyncio.sleep(0, [session.session_id]))
        monkeypatch.setattr(Idle, "is_unused_here", lambda *_: True)
        await served.gateway.sessions.sweep()
        assert "could not be" not in caplog.text
        assert (await store.get(session.session_id)).ended_at is None
        assert len(await store.audit(session.session_id, 0)) == 2  # none after what was promised


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("public_keys", "{"),
        ("public_keys", "[]"),
        ("teammates", "5"),
        ("token_ids", "null"),
        ("latency_budget_ms", "soon"),
        ("last_frame", "the first"),
        ("audit_seq", 1.5),
        ("seed", b"\0"),
        ("seed", "0" * 20),
        ("seed", "0" * 30 + " " + "0" * 33),
        ("teammates", "[1]"),
        ("token_ids", '{"car-1": 1}'),
    ],
)
async def test_a_damaged_session_is_unavailable_and_no_fault_of_the_gateway(
    column, value, tmp_path, good_frame, caplog
):
    path = tmp_path / "robosac.db"
    async with serve(database_url=f"sqlite:///{path}") as served:
        damaged, whole = await served.open(), await served.open()
        database = sqlite3.connect(path)
        with database:
            change = f"UPDATE sessions SET {column} = ? WHERE session_id = ?"
            database.execute(change, [value, damaged.session_id])
        database.close()
        bearer = {"Authorization": f"Bearer {damaged.ego_token}"}
        answer = await served.http.get(f"/v1/sessions/{damaged.session_id}", headers=bearer)
        problem(answer, 503, "store-unavailable")
        assert "is damaged" in caplog.text
        assert "0" * 20 not in caplog.text
        await served.ego(whole).post_frame_body(good_frame(0))


@pytest.mark.parametrize("missing", [1, 2])
async def test_a_log_of_which_lines_are_missing_is_damaged_and_not_purged(missing, served, good_frame, caplog):
    session, store = await served.open(), served.gateway.store
    await served.post(session, "frames", good_frame(0))
    gone = delete(audit_lines).where(audit_lines.c.seq == missing)
    await store._database.write(lambda connection: connection.execute(gone))
    bearer = {"Authorization": f"Bearer {session.ego_token}"}
    answer = await served.http.get(f"/v1/sessions/{session.session_id}/audit", headers=bearer)
    problem(answer, 503, "store-unavailable")
    assert f"the log of session {session.session_id} is damaged after record 0" in caplog.text


@pytest.mark.parametrize("value", ["{}", '{"a": 1}', '{"kind": []}', '{"kind": "none", "a": 1}'])
async def test_a_session_whose_defence_is_damaged_is_not_served(value, tmp_path):
    database = {"database_url": f"sqlite:///{tmp_path}/robosac.db"}
    async with serve(**database) as served:
        damaged = await served.open()
        with contextlib.closing(sqlite3.connect(tmp_path / "robosac.db")) as rows, rows:
            rows.execute("UPDATE sessions SET defense = ?", [value])
    async with serve(**database) as served:
        bearer = {"Authorization": f"Bearer {damaged.ego_token}"}
        answer = await served.http.get(f"/v1/sessions/{damaged.session_id}", headers=bearer)
        assert answer.status_code in {409, 503}, answer.text


async def test_a_log_whose_first_page_cannot_be_read_is_a_problem_and_no_empty_log(served, monkeypatch):
    session = await served.open()

    async def fails(*_):
        raise StoreUnavailable

    monkeypatch.setattr(served.gateway.store, "audit", fails)
    bearer = {"Authorization": f"Bearer {session.ego_token}"}
    problem(await served.http.get(f"/v1/sessions/{session.session_id}/audit", headers=bearer), 503, "store-unavailable")


async def test_a_session_that_could_not_be_ended_goes_on_with_the_messages_that_wait(served, messages, monkeypatch):
    session = await served.open(gather_ms=20)
    await served.teammate(session, "rsu").send(0, messages["rsu"])

    async def fails(*_):
        raise StoreUnavailable

    with monkeypatch.context() as patched:
        patched.setattr(served.gateway.store, "end", fails)
        bearer = {"Authorization": f"Bearer {session.ego_token}"}
        refused = await served.http.delete(f"/v1/sessions/{session.session_id}", headers=bearer)
        problem(refused, 503, "store-unavailable")
    answer = await served.ego(session).ask(0, messages[EGO])
    assert "rsu" in {*answer.accepted, *(h for test in answer.hypotheses for h in test.teammates)}
    await served.ego(session).close()


async def test_a_frame_bears_that_its_session_is_forgotten_meanwhile(served, messages):
    session = await served.open(gather_ms=200)
    asking = asyncio.create_task(served.ego(session).ask(0, messages[EGO]))
    await until(served.gateway.sessions._live[session.session_id].lock.locked)
    served.gateway.sessions._forget(session.session_id)
    assert {why.reason for why in (await asking).rejected.values()} == {"missing"}


async def test_an_ended_session_leaves_its_log_and_says_its_head(served, good_frame):
    session = await served.open()
    ego = served.ego(session)
    assert (await served.post(session, "frames", good_frame(0))).status_code == 200
    head = await ego.close()
    lines = [line.encode() for line in await ego.audit_lines()]
    assert [json.loads(line)["event"] for line in lines] == ["session_opened", "frame_answered", "session_ended"]
    assert verify(lines, head=head) == []
    assert verify(lines[:-1], head=head) != []
    headers = {"Authorization": f"Bearer {session.teammate_tokens['rsu']}"}
    response = await served.http.get(f"/v1/sessions/{session.session_id}/audit", headers=headers)
    problem(response, 403, "ego-only")
    problem(await served.post(session, "frames", good_frame(1)), 404, "unknown-session")
