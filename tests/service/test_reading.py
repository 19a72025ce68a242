"""Bodies that take long to read are read elsewhere than on the event loop, by fair shares of keys and sessions."""

import asyncio
import math
import os
import threading
import time

import pytest

from clients.client import GatewayClient
from robosac import wire
from service.arriving.checking import InFrame, read_frame
from service.arriving.pacing import OTHERS
from service.arriving.reading import READ_AT_A_TIME, FairLine
from service.turns import Turns, Work
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
        yield

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
        yield

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


async def test_a_body_that_takes_long_lets_others_be_read_in_between(monkeypatch, good_frame):
    done, begun = [], []

    def in_parts(caller, body):
        begun.append(caller.live.key)
        for _ in range(60 if caller.live.key == begun[0] else 0):
            time.sleep(0.02)
            yield
        done.append(caller.live.key)
        return (yield from read_frame(caller, body))

    monkeypatch.setattr("service.arriving.frames.read_frame", in_parts)
    async with serve(api_keys=f"{KEY},{OTHER_KEY}") as served:
        greedy, other = [await opened_with(served, KEY) for _ in range(4)], await opened_with(served, OTHER_KEY)
        posts = [asyncio.create_task(served.post(one, "frames", good_frame(0))) for one in greedy]
        while len(begun) < READ_AT_A_TIME:
            await asyncio.sleep(0.001)
        assert (await served.post(other, "frames", good_frame(0))).status_code == 200
        first = list(done)
        assert {answer.status_code for answer in await asyncio.gather(*posts)} == {200}
    assert len(first) == 1
    assert first[0] != done[-1]


@pytest.mark.parametrize("fails", [False, True])
async def test_the_time_that_reading_takes_is_put_down_to_the_sender(fails, monkeypatch, good_frame):
    worked_s, charged = 0.03, []

    def works(caller, body):
        for _ in range(2):
            until = time.thread_time() + worked_s / 2
            while time.thread_time() < until:
                pass
            yield
        if fails:
            raise InFrame(wire.WireError("malformed-msgpack", "", "it is read in vain"), None)
        return (yield from read_frame(caller, body))

    async with serve() as served:
        session = await served.open()
        monkeypatch.setattr("service.arriving.frames.read_frame", works)
        pacing, put_down = served.gateway.frames.reading.pacing, []
        monkeypatch.setattr(pacing, "charge", lambda party, seconds: charged.append((party, seconds)))
        monkeypatch.setattr(served.gateway.engine, "put_down", lambda work, seconds: put_down.append((work, seconds)))
        answer = await served.post(session, "frames", good_frame(0))
        assert answer.status_code == (400 if fails else 200)
        headers = [(b"authorization", f"Bearer {session.ego_token}".encode())]
        party = pacing.party_of({"client": ("10.0.0.1", 1), "headers": headers})
    assert {who for who, _ in charged} == {party}
    assert party[0] != OTHERS
    assert sum(seconds for _, seconds in charged) * (os.cpu_count() or 1) >= worked_s
    assert [seconds for _, seconds in put_down] == [seconds for _, seconds in charged]
    assert {work.session_id for work, _ in put_down} == {session.session_id}


async def test_whoever_had_too_much_of_the_time_waits_to_be_read(monkeypatch, good_frame):
    async with serve() as served:
        session = await served.open(latency_budget_ms=5000.0)
        pacing, over, asked = served.gateway.frames.reading.pacing, [True] * 3, []

        def is_over(party):
            asked.append(party)
            return bool(over) and over.pop()

        monkeypatch.setattr(pacing, "is_over", is_over)
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        assert len(asked) > 3
        monkeypatch.setattr(pacing, "is_over", lambda party: True)
        hurried = await served.open(latency_budget_ms=100.0, gather_ms=10.0)
        problem(await served.post(hurried, "frames", good_frame(0)), 503, "overloaded")
        monkeypatch.setattr(pacing, "is_over", lambda party: False)
        assert (await served.post(hurried, "frames", good_frame(0))).status_code == 200


async def test_a_body_that_nobody_waits_for_any_more_keeps_its_turn_while_it_is_read(monkeypatch, good_frame):
    reading, counts, charged = set(), [], []

    def works(caller, body):
        me = object()
        reading.add(me)
        counts.append(len(reading))
        until = time.thread_time() + 0.1
        while time.thread_time() < until:
            pass
        reading.remove(me)
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is read in vain"), None)
        yield

    async with serve() as served:
        session = await served.open(latency_budget_ms=5000.0)
        monkeypatch.setattr("service.arriving.frames.read_frame", works)
        pacing = served.gateway.frames.reading.pacing
        monkeypatch.setattr(pacing, "charge", lambda party, seconds: charged.append(seconds))
        posts = []
        for number in range(READ_AT_A_TIME):
            posts.append(asyncio.create_task(served.post(session, "frames", good_frame(0))))
            async with asyncio.timeout(10.0):
                while len(counts) <= number:
                    await asyncio.sleep(0.001)
        for post in posts:
            post.cancel()
        problem(await served.post(session, "frames", good_frame(0)), 400, "malformed-msgpack")
        ends = await asyncio.gather(*posts, return_exceptions=True)
        assert all(isinstance(end, asyncio.CancelledError) for end in ends)
        async with asyncio.timeout(10.0):
            while len(charged) < len(posts) + 1:
                await asyncio.sleep(0.001)
    assert max(counts) <= READ_AT_A_TIME
    assert min(charged) * (os.cpu_count() or 1) >= 0.1


def shares_of(*had):
    """Shares of work that is done elsewhere, and what each had."""
    turns = Turns()
    for work, _ in had:
        turns.join(work)
    for work, seconds in had:
        turns.put_down(work, seconds)
    return turns


def work_of(key, session_id="s", expected_s=0.0):
    return Work(key, session_id, math.inf, expected_s)


async def test_whoever_had_least_is_read_first():
    works = [work_of("much", "a"), work_of("little", "more"), work_of("little", "less"), work_of("little", "most")]
    line = FairLine(shares_of(*zip(works, [0.5, 0.02, 0.01, 0.03], strict=True)), gives_way=False)
    held = [await line.turn(("any", "s", "v")) for _ in range(READ_AT_A_TIME)]
    order = []

    async def is_read(work):
        turn = await line.turn((work.key, work.session_id, "ego"))
        order.append(work.session_id)
        turn.end()

    reads = [asyncio.create_task(is_read(work)) for work in works]
    await asyncio.sleep(0)
    held[0].end()
    async with asyncio.timeout(10.0):
        await asyncio.gather(*reads)
    assert order == ["less", "more", "most", "a"]


@pytest.mark.parametrize(
    ("had_s", "frame_had_s", "gives_way", "waits"),
    [(0.2, 0.0, True, True), (0.2, 0.0, False, False), (0.0, 0.0, True, False), (0.2, 0.18, True, False)],
)
async def test_on_one_core_bodies_wait_for_frames_of_those_who_will_have_had_less(had_s, frame_had_s, gives_way, waits):
    body, frame = work_of("body"), work_of("frame", expected_s=0.05)
    turns = shares_of((body, had_s), (frame, frame_had_s))
    turns.add(frame)
    line = FairLine(turns, gives_way=gives_way)
    read = asyncio.create_task(line.turn((body.key, body.session_id, "ego")))
    for _ in range(5):
        await asyncio.sleep(0.005)
    assert read.done() is not waits
    turns.remove(frame)
    async with asyncio.timeout(10.0):
        (await read).end()


@pytest.mark.parametrize(("cores", "status"), [(1, 503), (2, 200)])
async def test_only_on_one_core_bodies_wait_for_frames(cores, status, monkeypatch, good_frame):
    monkeypatch.setattr("service.arriving.reading._CORES", cores)
    async with serve() as served:
        session = await served.open(latency_budget_ms=1500.0, gather_ms=10.0)
        monkeypatch.setattr(served.gateway.engine, "puts_off", lambda work: True)
        assert (await served.post(session, "frames", good_frame(0))).status_code == status


async def test_all_that_a_body_waits_for_its_turns_counts(monkeypatch, good_frame):
    def in_parts(caller, body):
        for _ in range(20):
            time.sleep(0.006)
            yield
        return (yield from read_frame(caller, body))

    async def waits(party):
        await asyncio.sleep(0.03)

    async with serve() as served:
        session = await served.open(latency_budget_ms=400.0, gather_ms=10.0)
        monkeypatch.setattr("service.arriving.frames.read_frame", in_parts)
        monkeypatch.setattr(served.gateway.frames.reading.pacing, "turn", waits)
        problem(await served.post(session, "frames", good_frame(0)), 503, "overloaded")


async def test_a_small_body_that_may_be_compressed_is_not_read_on_the_event_loop(served, monkeypatch, messages):
    read = []

    def where(*_):
        read.append(threading.current_thread() is threading.main_thread())
        raise InFrame(wire.WireError("malformed-msgpack", "", "it is not read"), None)
        yield

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
        yield

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
