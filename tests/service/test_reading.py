"""Bodies that take long to read are read elsewhere than on the event loop, by turns of keys."""

import asyncio
import threading
import time

from clients.client import GatewayClient
from robosac import wire
from service.arriving.checking import InFrame
from service.arriving.giving_way import AT_A_TIME
from tests.service.conftest import EGO, TEAM, problem, serve
from tests.service.credentials import KEY, OTHER_KEY


async def opened_with(served, key):
    client = GatewayClient("http://gateway", key, transport=served.http._transport)
    return await client.open_session(EGO, TEAM)


async def test_bodies_are_read_by_turns_of_keys(monkeypatch, good_frame):
    read = []

    def slowly(caller, _):
        read.append(caller.live.key)
        time.sleep(0.05)
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is read slowly"), None)

    monkeypatch.setattr("service.arriving.frames.read_frame", slowly)
    async with serve(api_keys=f"{KEY},{OTHER_KEY}") as served:
        greedy, other = [await opened_with(served, KEY) for _ in range(4)], await opened_with(served, OTHER_KEY)
        posts = [asyncio.create_task(served.post(one, "frames", good_frame(0))) for one in greedy * 3]
        while len(read) < AT_A_TIME:
            await asyncio.sleep(0.001)
        problem(await served.post(other, "frames", good_frame(0)), 400, "malformed-msgpack")
        await asyncio.gather(*posts)
    assert len(read) == len(posts) + 1
    assert len(set(read[: AT_A_TIME + 2])) == 2


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
