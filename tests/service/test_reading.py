"""Bodies that take long to read are read elsewhere than on the event loop, by turns of keys."""

import asyncio
import threading
import time

from clients.client import GatewayClient
from robosac import wire
from service.arriving.checking import InFrame
from service.arriving.frames import READ_AT_A_TIME
from tests.service.conftest import EGO, TEAM, problem, serve
from tests.service.credentials import KEY, OTHER_KEY


async def opened_with(served, key):
    client = GatewayClient("http://gateway", key, transport=served.http._transport)
    return await client.open_session(EGO, TEAM, latency_budget_ms=5000.0)


async def test_bodies_are_read_by_turns_of_keys(monkeypatch, good_frame):
    read = []

    def slowly(caller, _):
        read.append(caller.live.key)
        time.sleep(0.25)  # the other key's body is in line before the next turn, on a slow machine, too
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is read slowly"), None)

    monkeypatch.setattr("service.arriving.frames.read_frame", slowly)
    async with serve(api_keys=f"{KEY},{OTHER_KEY}") as served:
        greedy, other = [await opened_with(served, KEY) for _ in range(4)], await opened_with(served, OTHER_KEY)
        posts = [asyncio.create_task(served.post(one, "frames", good_frame(0))) for one in greedy * 3]
        while len(read) < READ_AT_A_TIME:
            await asyncio.sleep(0.001)
        problem(await served.post(other, "frames", good_frame(0)), 400, "malformed-msgpack")
        await asyncio.gather(*posts)
    assert len(read) == len(posts) + 1
    assert len(set(read[: READ_AT_A_TIME + 2])) == 2


async def test_bodies_of_a_session_are_read_by_turns_of_its_vehicles(monkeypatch, messages, good_frame):
    read = []

    def slowly(caller, _):
        read.append(caller.vehicle_id)
        time.sleep(0.25)
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is read slowly"), None)

    for name in ("read_frame", "read_message"):
        monkeypatch.setattr(f"service.arriving.frames.{name}", slowly)
    async with serve() as served:
        session = await served.open()
        token, body = session.teammate_tokens["rsu"], wire.pack_message(0, "rsu", messages["rsu"])
        posts = [asyncio.create_task(served.post(session, "messages", body, token)) for _ in range(12)]
        while len(read) < READ_AT_A_TIME:
            await asyncio.sleep(0.001)
        problem(await served.post(session, "frames", good_frame(0)), 400, "malformed-msgpack")
        await asyncio.gather(*posts)
    assert len(read) == len(posts) + 1
    assert EGO in read[: 2 * READ_AT_A_TIME + 1]


async def test_a_small_body_that_may_be_compressed_is_not_read_on_the_event_loop(served, monkeypatch, messages):
    read = []

    def where(*_):
        read.append(threading.current_thread() is threading.main_thread())
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is not read"), None)

    monkeypatch.setattr("service.arriving.frames.read_message", where)
    session = await served.open()
    pose, fields = messages[EGO].pose.ravel().tolist(), {"dtype": "float16", "shape": [64, 32, 32], "data": b""}
    for more in ({}, {"compression": "zstd"}):
        body = wire.pack({"frame": 0, "vehicle_id": EGO, "pose": pose, "tensors": {"features": {**fields, **more}}})
        problem(await served.post(session, "messages", body), 400, "malformed-msgpack")
    assert read == [True, False]


async def test_a_body_that_waits_for_half_of_its_budget_is_refused_unread(monkeypatch, good_frame):
    going_on = threading.Event()

    def never(*_):
        going_on.wait(10)
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is read for ever"), None)

    async with serve() as served:
        slow = [await served.open() for _ in range(READ_AT_A_TIME)]
        session = await served.open(latency_budget_ms=200.0, gather_ms=50.0)
        with monkeypatch.context() as patch:
            patch.setattr("service.arriving.giving_way.TURN_S", 10.0)
            patch.setattr("service.arriving.frames.read_frame", never)
            posts = [asyncio.create_task(served.post(one, "frames", good_frame(0))) for one in slow]
            await asyncio.sleep(0.05)
            began = time.perf_counter()
            problem(await served.post(session, "frames", good_frame(0)), 503, "overloaded")
            assert time.perf_counter() - began < 5.0
            going_on.set()
            await asyncio.gather(*posts)
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
