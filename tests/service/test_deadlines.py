"""What a frame says of its time is true, and a store that stalls costs no more than the frames that it stalls."""

import asyncio
import sqlite3
import time

import pytest

from clients.errors import GatewayUnavailable
from robosac import wire
from service import routes
from service.errors import StoreUnavailable
from service.keeping.patience import GRACE_S
from tests.service.conftest import EGO, TEAM, problem, serve

BUDGET_MS = 400
SLOWER_S = 0.5
"""What a busy machine may take longer than promised."""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "robosac.db"


@pytest.fixture
async def on_disk(path):
    async with serve(database_url=f"sqlite:///{path}") as served:
        yield served


async def late_frames(served):
    text = (await served.http.get("/metrics")).text
    return float(next(line.split()[1] for line in text.splitlines() if line.startswith("robosac_late_frames_total ")))


class Locked:
    """Another connection that holds the database's write lock for a block."""

    def __init__(self, path):
        self.connection = sqlite3.connect(path, isolation_level=None)

    def __enter__(self):
        self.connection.execute("BEGIN IMMEDIATE")
        return self

    def __exit__(self, *_):
        self.connection.execute("ROLLBACK")
        self.connection.close()


async def test_a_locked_database_costs_the_frames_that_it_stalls_their_answers_and_no_more(on_disk, path, good_frame):
    session = await on_disk.open(latency_budget_ms=BUDGET_MS, gather_ms=0)
    assert (await on_disk.post(session, "frames", good_frame(0))).status_code == 200
    took, late_before = [], await late_frames(on_disk)
    with Locked(path):
        end = time.perf_counter() + 3.0
        while time.perf_counter() < end:
            began = time.perf_counter()
            refused = await on_disk.post(session, "frames", good_frame(1))
            took.append(time.perf_counter() - began)
            problem(refused, 503, "store-too-slow")
            assert ("nothing of this one is kept" if took[1:] else "nothing of it is kept") in refused.json()["detail"]
    assert max(took) < BUDGET_MS / 1e3 + GRACE_S + SLOWER_S
    assert await late_frames(on_disk) - late_before == len(took) >= 3
    answers = [(await on_disk.post(session, "frames", good_frame(frame))) for frame in (1, 2)]
    assert answers[-1].status_code == 200
    assert answers[-1].json()["source"] == "consensus"
    records = [r for r in await on_disk.ego(session).audit() if r["event"] == "frame_answered"]
    kept = [1] if answers[0].status_code == 200 else []
    assert [record["frame"] for record in records] == [0, *kept, 2]
    state = await on_disk.ego(session).state()
    assert (state["last_frame"], state["frames_answered"]) == (2, len(records))


async def test_a_session_whose_row_is_held_asks_the_store_for_one_thing_at_a_time(on_disk, good_frame, monkeypatch):
    session, store = await on_disk.open(latency_budget_ms=BUDGET_MS, gather_ms=0), on_disk.gateway.store
    let_go, asked, decide = asyncio.Event(), [], store.decide

    async def held(record, event, *others):
        asked.append(event.frame)
        await let_go.wait()
        return await decide(record, event, *others)

    with monkeypatch.context() as holding:
        holding.setattr(store, "decide", held)
        for frame in range(3):
            problem(await on_disk.post(session, "frames", good_frame(frame)), 503, "store-too-slow")
        assert asked == [0]
        let_go.set()
        await on_disk.post(session, "frames", good_frame(3))
    assert asked == [0, 3]


async def test_a_frame_asked_for_again_after_a_failed_store_finds_its_messages(on_disk, path, messages):
    session = await on_disk.open(latency_budget_ms=300, gather_ms=200)
    for name in TEAM:
        await on_disk.teammate(session, name).send(0, messages[name])
    with Locked(path), pytest.raises(GatewayUnavailable):
        await on_disk.ego(session).ask(0, messages[EGO])
    waiting = on_disk.gateway.sessions.backlog.nbytes
    await asyncio.sleep(0.2)
    answer = await on_disk.ego(session).ask(0, messages[EGO])
    assert set(answer.accepted) == set(TEAM)
    assert waiting > 0
    assert on_disk.gateway.sessions.backlog.nbytes == 0


async def test_what_comes_while_a_decision_is_made_is_late_even_if_that_is_not_kept(hooked, messages):
    session = await hooked.open(gather_ms=20)
    loop, late = asyncio.get_running_loop(), []

    class Meanwhile:
        """A defence that is asked while a message comes."""

        def __init__(self, defense):
            self.defense = defense

        def __getattr__(self, name):
            return getattr(self.defense, name)

        def converse(self, *asked):
            body = wire.pack_message(0, "rsu", messages["rsu"])
            posting = hooked.post(session, "messages", body, session.teammate_tokens["rsu"])
            late.append(asyncio.run_coroutine_threadsafe(posting, loop).result())
            return self.defense.converse(*asked)

    decides = hooked.gateway.sessions._live[session.session_id].session
    usual, decides.defense = decides.defense, Meanwhile(decides.defense)
    await hooked.teammate(session, "car-2").send(0, messages["car-2"])
    assert (await hooked.ego(session).ask(0, messages[EGO])).accepted == ("car-2",)
    problem(late[0], 409, "stale-frame")
    decides.defense = usual
    assert (await hooked.ego(session).ask(1, messages[EGO])).rejected["rsu"].reason == "late"


async def test_a_decision_past_the_point_of_return_is_found_out_about_before_the_next(on_disk, good_frame):
    """The database begins to commit in time, and takes long over it."""
    session = await on_disk.open(latency_budget_ms=1000, gather_ms=0)
    assert (await on_disk.post(session, "frames", good_frame(0))).status_code == 200
    database = on_disk.gateway.store._database
    before = asyncio.create_task(database.write(lambda _: time.sleep(0.8)))
    await asyncio.sleep(0.05)
    posting = asyncio.create_task(on_disk.post(session, "frames", good_frame(1)))
    while not any(piece.work.__qualname__.startswith("Store._append") for piece, _ in database._waiting):
        await asyncio.sleep(0.005)
    with_it = asyncio.create_task(database.write(lambda _: time.sleep(1.6)))
    refused = await posting
    problem(refused, 503, "store-too-slow")
    assert "still writing" in refused.json()["detail"]
    problem(await on_disk.post(session, "frames", good_frame(1)), 409, "stale-frame")
    await asyncio.gather(before, with_it)
    assert (await on_disk.post(session, "frames", good_frame(2))).json()["source"] == "consensus"
    records = [r for r in await on_disk.ego(session).audit() if r["event"] == "frame_answered"]
    assert [(record["frame"], record.get("late", [])) for record in records] == [(0, []), (1, []), (2, [1])]


def failing_after(keep, *, kept):
    """A store that keeps what it is given, or does not, and fails then."""

    async def fail(*arguments):
        if kept:
            await keep(*arguments)
        raise StoreUnavailable

    return fail


async def late_of_all(ego):
    told = (r for r in await ego.audit() if r["event"] in ("frame_answered", "session_ended"))
    return [record.get("late", []) for record in told]


@pytest.mark.parametrize(("kept", "end"), [(True, "frame"), (True, "close"), (False, "frame")])
async def test_a_decision_of_which_the_store_does_not_say_whether_it_is_kept_was_late(
    on_disk, good_frame, monkeypatch, kept, end
):
    session, store = await on_disk.open(latency_budget_ms=2000, gather_ms=0), on_disk.gateway.store
    with monkeypatch.context() as failing:
        failing.setattr(store, "decide", failing_after(store.decide, kept=kept))
        problem(await on_disk.post(session, "frames", good_frame(0)), 503, "store-unavailable")
    again = await on_disk.post(session, "frames", good_frame(0))
    if kept:
        problem(again, 409, "stale-frame")
    assert again.status_code == 409 or again.json()["deadline_met"]
    if end == "frame":
        assert (await on_disk.post(session, "frames", good_frame(1))).status_code == 200
    ego, late = on_disk.ego(session), [0] if kept else []
    await ego.close()
    assert await late_of_all(ego) == ([[], late, []] if end == "frame" else [[], late])


async def test_of_an_idle_session_it_is_found_out_as_well(path, good_frame, monkeypatch):
    async with serve(database_url=f"sqlite:///{path}", session_idle_s=1) as served:
        session, store = await served.open(latency_budget_ms=2000, gather_ms=0), served.gateway.store
        monkeypatch.setattr(store, "decide", failing_after(store.decide, kept=True))
        problem(await served.post(session, "frames", good_frame(0)), 503, "store-unavailable")
        while (await store.get(session.session_id)).ended_at is None:
            await asyncio.sleep(0.3)
            await served.gateway.sessions.sweep()
        assert await late_of_all(served.ego(session)) == [[], [0]]


async def test_what_another_process_answered_in_time_was_not_late(path, good_frame, monkeypatch):
    url = f"sqlite:///{path}"
    async with serve(database_url=url) as one, serve(database_url=url) as other:
        session, store = await one.open(latency_budget_ms=2000, gather_ms=0), one.gateway.store
        with monkeypatch.context() as failing:
            failing.setattr(store, "decide", failing_after(store.decide, kept=False))
            problem(await one.post(session, "frames", good_frame(0)), 503, "store-unavailable")
        assert (await other.post(session, "frames", good_frame(0))).json()["deadline_met"]
        assert (await one.post(session, "frames", good_frame(1))).status_code == 200
        assert await late_of_all(one.ego(session)) == [[], []]


@pytest.mark.parametrize("stalled", ["store", "engine"])
async def test_one_stall_does_not_cost_the_next_frames_their_tests(stalled, hooked, good_frame):
    session = await hooked.open(latency_budget_ms=1000, gather_ms=0)
    for frame in range(3):
        await hooked.post(session, "frames", good_frame(frame))
    if stalled == "store":
        stall = asyncio.create_task(hooked.gateway.store._database.write(lambda _: time.sleep(0.9)))
        await asyncio.sleep(0.01)
    else:
        hooked.detector.before_prepare = lambda *_: time.sleep(1.1)
        stall = None
    slow = await hooked.post(session, "frames", good_frame(3))
    hooked.detector.before_prepare = None
    assert slow.status_code == 503 or slow.json()["timings_ms"]["total"] > 600
    for frame in range(4, 10):
        result = (await hooked.post(session, "frames", good_frame(frame))).json()
        assert (result["source"], result["degraded_by"], result["deadline_met"]) == ("consensus", None, True), frame
    if stall is not None:
        await stall


async def test_an_answer_that_waited_for_the_store_until_it_was_late_says_so(on_disk, good_frame):
    session = await on_disk.open(latency_budget_ms=600, gather_ms=0)
    await on_disk.post(session, "frames", good_frame(0))
    late_before = await late_frames(on_disk)
    stall = asyncio.create_task(on_disk.gateway.store._database.write(lambda _: time.sleep(0.8)))
    await asyncio.sleep(0.01)
    result = (await on_disk.post(session, "frames", good_frame(1))).json()
    await stall
    assert (result["frame"], result["deadline_met"]) == (1, False)
    assert result["timings_ms"]["total"] > 600
    assert result["timings_ms"]["store"] > 100
    assert await late_frames(on_disk) - late_before == 1
    stall = asyncio.create_task(on_disk.gateway.store._database.write(lambda _: time.sleep(2.0)))
    await asyncio.sleep(0.01)
    problem(await on_disk.post(session, "frames", good_frame(2)), 503, "store-too-slow")  # which loses nothing
    await stall
    for frame in (3, 4):
        await on_disk.post(session, "frames", good_frame(frame))
    records = [r for r in await on_disk.ego(session).audit() if r["event"] == "frame_answered"]
    told = {record["frame"]: (record["deadline_met"], record.get("late", [])) for record in records}
    assert told == {0: (True, []), 1: (True, []), 3: (True, [1]), 4: (True, [])}


async def test_an_answer_that_took_until_it_was_late_to_be_written_out_says_so(on_disk, good_frame, monkeypatch):
    session = await on_disk.open(latency_budget_ms=BUDGET_MS, gather_ms=0)
    written_out = routes._negotiated

    def slowly(*answer):
        response = written_out(*answer)
        time.sleep(BUDGET_MS / 1e3)
        return response

    with monkeypatch.context() as slow:
        slow.setattr(routes, "_negotiated", slowly)
        answer = (await on_disk.post(session, "frames", good_frame(0))).json()
    assert not answer["deadline_met"]
    assert answer["timings_ms"]["total"] > BUDGET_MS
    await asyncio.sleep(0.1)  # what comes right after the event loop stood still may have come before
    assert (await on_disk.post(session, "frames", good_frame(1))).json()["deadline_met"]
    records = [record for record in await on_disk.ego(session).audit() if record["event"] == "frame_answered"]
    assert [(record["deadline_met"], record.get("late", [])) for record in records] == [(True, []), (True, [0])]


async def test_the_end_of_a_session_tells_of_its_last_late_frame(on_disk, good_frame):
    session = await on_disk.open(latency_budget_ms=1000, gather_ms=0)
    stall = asyncio.create_task(on_disk.gateway.store._database.write(lambda _: time.sleep(1.1)))
    await asyncio.sleep(0.01)
    assert (await on_disk.post(session, "frames", good_frame(0))).json()["deadline_met"] is False
    await stall
    ego = on_disk.ego(session)
    await ego.close()
    *_, ended = await ego.audit()
    assert (ended["event"], ended["late"]) == ("session_ended", [0])
