"""Sessions that move from one gateway process to another, with what waited for them."""

import asyncio
import time

import pytest

from clients.errors import GatewayUnavailable
from clients.standby import Standby
from robosac import wire
from service.sessions.gathering import MOVED
from service.sessions.moving import LOOK_FOR_S, news
from tests.service.conftest import EGO, HOOKED, TEAM, problem, serve, until


@pytest.fixture
async def two(tmp_path):
    options = {"database_url": f"sqlite:///{tmp_path}/robosac.db", "extra_detectors": HOOKED}
    async with serve(**options) as one, serve(**options) as other:
        yield one, other


async def caller(served, session, name):
    token = session.ego_token if name == EGO else session.teammate_tokens[name]
    return await served.gateway.sessions.authenticate(session.session_id, token)


async def test_what_waited_elsewhere_is_missing_and_the_answer_says_why(two, messages):
    one, other = two
    session = await one.open(gather_ms=30)
    await one.teammate(session, "rsu").send(0, messages["rsu"])
    await other.teammate(session, "car-2").send(0, messages["car-2"])
    answer = await other.ego(session).ask(0, messages[EGO])
    assert answer.accepted == ("car-2",)
    assert answer.rejected["rsu"].reason == "missing"
    assert answer.rejected["rsu"].detail == MOVED
    again = await other.ego(session).ask(1, messages[EGO])
    assert (again.rejected["rsu"].reason, again.rejected["rsu"].model_extra) == ("missing", {})


async def test_in_the_process_that_opened_it_a_first_message_that_is_not_there_was_not_sent(served, messages):
    session = await served.open(gather_ms=10)
    answer = await served.ego(session).ask(0, messages[EGO])
    assert answer.rejected["rsu"].model_extra == {}


async def test_the_log_names_the_process_that_decided(two, messages, benign):
    one, other = two
    session = await one.open(gather_ms=10)
    for frame, served in enumerate((one, one, other, one)):
        await served.ego(session).post_frame(frame, messages[EGO], benign)
    records = [record for record in await one.ego(session).audit() if record["event"] == "frame_answered"]
    names = [served.gateway.sessions.moving.name for served in (one, one, other, one)]
    assert [record["gateway"] for record in records] == names
    assert len(set(names)) == 2


async def test_a_vehicle_that_stands_by_is_sent_to_where_the_ego_asks_now(two, messages):
    one, other = two
    session = await one.open(gather_ms=30)
    await one.ego(session).ask(0, messages[EGO])
    with one.gateway.sessions.moving.standing_by(await caller(one, session, "rsu")) as standing:
        await one.teammate(session, "rsu").send(1, messages["rsu"])
        await asyncio.sleep(0.1)
        assert not standing.over.is_set()  # the ego may just be late
        asked = asyncio.create_task(other.ego(session).ask(1, messages[EGO]))
        await until(standing.over.is_set)
        await asked
    assert (await caller(one, session, EGO)).live.held is False


async def test_nobody_looks_for_an_ego_for_ever(served, messages):
    session = await served.open(gather_ms=30)
    await served.ego(session).ask(0, messages[EGO])
    rsu = await caller(served, session, "rsu")
    with served.gateway.sessions.moving.standing_by(rsu) as standing:
        await served.teammate(session, "rsu").send(1, messages["rsu"])
        moving = served.gateway.sessions.moving
        await asyncio.wait_for(moving.looking, LOOK_FOR_S + 5)
        assert not standing.over.is_set()
        assert moving.looking is None


async def test_a_vehicle_has_one_stream_and_hears_what_waits(served, messages):
    session = await served.open(gather_ms=30)
    moving, rsu = served.gateway.sessions.moving, await caller(served, session, "rsu")
    with moving.standing_by(rsu) as first, moving.standing_by(rsu) as second:
        assert (first.over.is_set(), second.over.is_set()) == (True, False)
        assert [None async for _ in news(first)] == []
    assert rsu.live.standing == {}
    await served.teammate(session, "rsu").send(2, messages["rsu"])
    assert moving.known(rsu) == {"gateway": moving.name, "answered": -1, "waiting": [2]}
    await served.ego(session).ask(2, messages[EGO])
    assert moving.known(rsu) == {"gateway": moving.name, "answered": 2, "waiting": []}


async def test_a_process_that_is_to_end_sends_everybody_on_and_answers_what_it_has(two, messages, benign):
    one, other = two
    session, second = await one.open(gather_ms=5000), await one.open(gather_ms=5000)
    waiting = asyncio.create_task(one.post(session, "messages", wire.pack_message(0, EGO, messages[EGO])))
    await until(one.gateway.sessions.in_use(session.session_id).lock.locked)
    loop, stopped = asyncio.get_running_loop(), []

    def stop(_, teammates):
        if teammates and not stopped:  # a whole frame, and not the one that is begun while its teammates are waited for
            stopped.append(True)
            loop.call_soon_threadsafe(one.gateway.stop)

    one.detector.before_prepare = stop
    with one.gateway.sessions.moving.standing_by(await caller(one, session, "rsu")) as standing:
        in_hand = await one.ego(second).post_frame(0, messages[EGO], benign)
        assert in_hand.source == "consensus"
        refused = await waiting
        assert standing.over.is_set()
    problem(refused, 503, "draining")
    assert refused.headers["retry-after"] == "0"
    problem(await one.http.get("/readyz"), 503, "draining")
    mine = wire.pack_message(0, "rsu", messages["rsu"])
    problem(await one.post(session, "messages", mine, session.teammate_tokens["rsu"]), 503, "draining")
    for name in TEAM:
        await other.teammate(session, name).send(0, messages[name])
    assert (await other.ego(session).ask(0, messages[EGO])).source == "consensus"
    assert (await other.ego(second).post_frame(1, messages[EGO], benign)).source == "consensus"


async def test_a_client_asks_again_while_a_process_ends_but_not_for_ever(served, messages):
    session = await served.open()
    served.gateway.stop()
    began = time.monotonic()
    asking = asyncio.create_task(served.teammate(session, "rsu").send(0, messages["rsu"]))
    await asyncio.sleep(0.1)
    served.gateway.sessions.moving.draining = False
    await asking
    served.gateway.sessions.moving.draining = True
    with pytest.raises(GatewayUnavailable, match="draining"):
        await served.teammate(session, "rsu").send(1, messages["rsu"])
    assert time.monotonic() - began < 10


async def test_what_is_answered_or_waits_is_not_sent_again():
    posted, streams = [], [{"answered": 1, "waiting": [3], "gateway": "b"}]

    async def events():
        if not streams:
            await asyncio.Event().wait()
        yield "standing", streams.pop()

    async def send(body):
        posted.append(body)

    standby = Standby(events, send)
    for frame in range(5):
        await standby.sent(frame, b"%d" % frame, 0)
    running = asyncio.create_task(standby.run())
    await until(lambda: standby.sent_again == [2, 4])
    running.cancel()
    assert posted == [b"2", b"4"]


async def test_what_was_being_sent_when_the_stream_ended_is_sent_again():
    posted, ended = [], asyncio.Event()

    async def events():
        yield "standing", {"answered": 3, "waiting": [], "gateway": "b"}
        await ended.wait()
        ended.clear()

    async def send(body):
        posted.append(body)

    standby = Standby(events, send)
    running = asyncio.create_task(standby.run())
    await until(standby.standing.is_set)
    in_hand = standby.streams
    await standby.sent(4, b"4", in_hand)
    assert posted == []
    ended.set()
    await until(lambda: standby.streams > in_hand and standby.standing.is_set())
    assert posted == [b"4"]
    await standby.sent(3, b"3", in_hand)  # which the first process took, and passes to nobody
    await standby.sent(5, b"5", in_hand)
    await standby.sent(6, b"6", standby.streams)
    running.cancel()
    assert (posted, standby.sent_again) == ([b"4", b"5"], [4, 5])
