"""What one session, or one API key, asks for costs the others little."""

import asyncio
import threading
import time
from collections import Counter

import pytest

from clients.client import GatewayClient
from clients.errors import RequestRefused
from robosac import wire
from robosac.detectors import EmbeddedDetector
from service.arriving.bodies import JSON_BYTES
from service.schemas import SessionCreated
from tests.service.conftest import EGO, TEAM, problem, serve
from tests.service.many import MANY

MY_TEAM = [f"m{i}" for i in range(12)]
PASS_S = 0.004


class Counting(EmbeddedDetector):
    """The shipped detector in its own place, whose passes take a while and are counted by the ego's place."""

    def __init__(self):
        super().__init__()
        self.passes = Counter()

    def prepare(self, ego, teammates):
        return Counted(self, super().prepare(ego, teammates), float(ego.pose[2, 3]))


class Counted:
    def __init__(self, detector, prepared, height_m):
        self.detector, self.prepared, self.height_m = detector, prepared, height_m

    def detect(self, teammates=()):
        self.detector.passes[round(self.height_m, 1)] += 1
        time.sleep(PASS_S)
        return self.prepared.detect(())  # that of the ego alone is cheap, and agrees with itself


COUNTING = "tests.service.test_fair_shares:Counting"
LONG = {"kind": "many_tests", "tests": 600}
SHORT = {"kind": "many_tests", "tests": 3}


@pytest.fixture
async def counting():
    keys = "a" * 20 + "," + "b" * 20
    async with serve(extra_detectors=COUNTING, extra_defenses=MANY, api_keys=keys) as served:
        yield served


def at_height(message, height_m):
    """The same message of an ego that is told from others by its sensor's height."""
    pose = message.pose.copy()
    pose[2, 3] = height_m
    return type(message)(pose, message.tensors)


async def open_one(served, key, team=MY_TEAM, **options):
    client = GatewayClient("http://gateway", key * 20, transport=served.http._transport)
    return await client.open_session(EGO, team, **options)


async def test_nine_sessions_that_wait_for_teammates_refuse_nobody(served, messages, good_frame):
    idle = [await served.open(latency_budget_ms=60_000, gather_ms=30_000) for _ in range(9)]
    waiting = [asyncio.create_task(served.ego(session).ask(0, messages[EGO])) for session in idle]
    session = await served.open(latency_budget_ms=1000, gather_ms=0)
    await asyncio.sleep(0.3)
    assert not any(task.done() for task in waiting)
    for frame in range(10):
        answer = await served.post(session, "frames", good_frame(frame))
        assert answer.status_code == 200
        assert (answer.json()["source"], answer.json()["deadline_met"]) == ("consensus", True)
    for task in waiting:
        task.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)


async def test_a_frame_of_many_hypotheses_and_a_long_budget_holds_nobody_up(counting, messages):
    ego, team = messages[EGO], dict.fromkeys(MY_TEAM, messages["rsu"])
    long = await open_one(counting, "a", defense=LONG, latency_budget_ms=60_000)
    short = await open_one(counting, "a", defense=SHORT, latency_budget_ms=3000, gather_ms=0)
    for frame in range(3):
        await counting.ego(short).post_frame(frame, ego, team)
    begun = asyncio.create_task(counting.ego(long).post_frame(0, ego, team))
    await asyncio.sleep(0.2)
    for frame in range(3, 11):
        began = time.perf_counter()
        answer = await counting.ego(short).post_frame(frame, ego, team)
        assert time.perf_counter() - began < 3.0
        assert (answer.sampling_steps, answer.degraded_by, answer.deadline_met) == (3, None, True)
    assert not begun.done()
    assert (await begun).sampling_steps == 600


async def test_a_key_with_ten_sessions_gets_no_more_of_the_engine_than_one_with_one(counting, messages):
    ego, team = messages[EGO], dict.fromkeys(MY_TEAM, messages["rsu"])
    options = {"defense": LONG, "latency_budget_ms": 60_000, "gather_ms": 0}
    many = [await open_one(counting, "a", **options) for _ in range(10)]
    one = await open_one(counting, "b", **options)
    passes = counting.detector.passes
    posts = [counting.ego(session).post_frame(0, at_height(ego, 2.0), team) for session in many]
    posts.append(counting.ego(one).post_frame(0, at_height(ego, 3.0), team))
    tasks = [asyncio.create_task(post) for post in posts]
    while passes[3.0] < 5:
        await asyncio.sleep(0.01)
    before = Counter(passes)
    await asyncio.sleep(2.0)
    had = {height: passes[height] - before[height] for height in (2.0, 3.0)}
    assert min(had.values()) > 20
    assert abs(had[2.0] - had[3.0]) <= 0.2 * sum(had.values())
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def test_the_passes_of_all_are_made_on_one_thread(hooked, good_frame):
    threads = set()
    hooked.detector.before_prepare = lambda *_: threads.add(threading.get_ident())
    sessions = [await hooked.open() for _ in range(4)]
    answers = await asyncio.gather(*(hooked.post(session, "frames", good_frame(0)) for session in sessions))
    assert {answer.status_code for answer in answers} == {200}
    assert len(threads) == 1
    assert threading.get_ident() not in threads


async def test_the_teammates_of_one_session_do_not_take_the_room_of_all(messages):
    async with serve(max_pending_bytes=2**22, max_pending_frames=30) as served:
        greedy, modest = await served.open(), await served.open()
        statuses = Counter()
        for frame in range(20):
            for name in TEAM:
                try:
                    await served.teammate(greedy, name).send(frame, messages[name])
                    statuses["kept"] += 1
                except Exception as error:
                    statuses[getattr(error, "status", None)] += 1
        assert statuses["kept"] >= 5
        assert statuses[503] == 100 - statuses["kept"]
        for name in TEAM:
            await served.teammate(modest, name).send(0, messages[name])
        assert set((await served.ego(modest).ask(0, messages[EGO])).accepted) == set(TEAM)


async def test_the_sessions_of_one_key_do_not_take_the_room_of_another_key(messages):
    settings = {"max_pending_bytes": 2**22, "max_pending_bytes_per_key": 2**21, "max_pending_frames": 30}
    async with serve(api_keys="a" * 20 + "," + "b" * 20, **settings) as served:
        refused = None
        for _ in range(12):
            greedy = served.teammate(await open_one(served, "a", TEAM), "rsu")
            for frame in range(2):
                try:
                    await greedy.send(frame, messages["rsu"])
                except Exception as error:
                    refused = error
        assert "ROBOSAC_MAX_PENDING_BYTES_PER_KEY" in str(refused)
        modest = await open_one(served, "b", TEAM, latency_budget_ms=20_000)
        for name in TEAM:
            await served.teammate(modest, name).send(0, messages[name])
        assert set((await served.ego(modest).ask(0, messages[EGO])).accepted) == set(TEAM)


async def test_bodies_of_one_session_leave_room_for_those_of_another(good_frame):
    async with serve(max_inflight_bytes=2 * 2**20) as served:
        greedy, modest = await served.open(), await served.open()
        body, go_on = good_frame(0), asyncio.Event()

        async def slowly():
            yield body[:1000]
            await go_on.wait()
            yield body[1000:]

        posts = [
            asyncio.create_task(served.post(greedy, "frames", slowly(), **{"Content-Length": str(len(body))}))
            for _ in range(3)
        ]
        await asyncio.sleep(0.1)
        refused = [task.result() for task in posts if task.done()]
        (held,) = [task for task in posts if not task.done()]
        for response in refused:
            assert "ROBOSAC_MAX_INFLIGHT_BYTES" in problem(response, 503, "overloaded")["detail"]
        assert (await served.post(modest, "frames", body)).status_code == 200
        go_on.set()
        assert (await held).status_code == 200
        assert served.gateway.bodies.nbytes == 0


@pytest.mark.parametrize("keys", ["a" * 20, "a" * 20 + "," + "b" * 20])
async def test_bodies_that_a_teammate_never_sends_keep_no_frame_out(keys, messages, good_frame):
    async with serve(max_inflight_bytes=4 * 2**20, api_keys=keys) as served:
        mine, other = await open_one(served, "a", TEAM), await open_one(served, "a", TEAM)

        async def never():
            await asyncio.Event().wait()
            yield b""

        token, size = mine.teammate_tokens["rsu"], len(wire.pack_message(0, "rsu", messages["rsu"]))
        posts = [
            asyncio.create_task(served.post(mine, "messages", never(), token, **{"Content-Length": str(size)}))
            for _ in range(40)
        ]
        await asyncio.sleep(0.3)
        assert 2 <= sum(not task.done() for task in posts) <= 8
        for session in (mine, other):
            assert (await served.post(session, "frames", good_frame(0))).status_code == 200
            await served.teammate(session, "car-2").send(1, messages["car-2"])
        for task in posts:
            task.cancel()
        await asyncio.gather(*posts, return_exceptions=True)
        assert served.gateway.bodies.nbytes == 0


async def test_openings_of_one_key_do_not_keep_another_from_opening():
    async with serve(max_inflight_bytes=2**20, api_keys="a" * 20 + "," + "b" * 20) as served:

        async def never():
            await asyncio.Event().wait()
            yield b""

        headers = {"Authorization": f"Bearer {'a' * 20}", "Content-Type": "application/json"}
        headers["Content-Length"] = str(JSON_BYTES)
        posts = [
            asyncio.create_task(served.http.post("/v1/sessions", content=never(), headers=headers)) for _ in range(6)
        ]
        await asyncio.sleep(0.3)
        assert any(task.done() for task in posts)
        await open_one(served, "b")
        for task in posts:
            task.cancel()
        await asyncio.gather(*posts, return_exceptions=True)


async def test_waiting_messages_of_one_teammate_leave_room_to_the_others_of_its_session(messages):
    settings = {"max_pending_bytes": 2**22, "max_pending_bytes_per_key": 2**21, "max_pending_frames": 30}
    async with serve(api_keys="a" * 20 + "," + "b" * 20, **settings) as served:
        session = await open_one(served, "a", TEAM, latency_budget_ms=20_000)

        async def send_ahead():
            for frame in range(31):
                await served.teammate(session, "rsu").send(frame, messages["rsu"])

        with pytest.raises(RequestRefused, match="no more than is left for others"):
            await send_ahead()
        for name in set(TEAM) - {"rsu"}:
            await served.teammate(session, name).send(0, messages[name])
        assert set((await served.ego(session).ask(0, messages[EGO])).accepted) == set(TEAM)


async def test_a_body_counts_as_what_its_tensors_hold_once_they_are_expanded(messages):
    ego, team, small = messages[EGO], dict.fromkeys(MY_TEAM, messages["rsu"]), wire.Packing(compress=True)
    body = wire.pack_frame(0, ego, team, packing=small)
    assert len(body) < 2**20 < len(wire.pack_frame(0, ego, team))
    async with serve(max_inflight_bytes=2**20) as served:
        session = await served.client.open_session(EGO, MY_TEAM, latency_budget_ms=20_000)
        refused = await served.post(session, "frames", body)
        assert "ROBOSAC_MAX_INFLIGHT_BYTES" in problem(refused, 503, "overloaded")["detail"]
        assert served.gateway.bodies.nbytes == 0
        assert (await served.post(session, "frames", wire.pack_frame(0, ego, {}, packing=small))).status_code == 200
        assert served.gateway.bodies.nbytes == 0


@pytest.mark.parametrize(
    ("setting", "most", "request_", "field"),
    [
        ("max_budget_ms", 500, {"latency_budget_ms": 501}, "latency_budget_ms"),
        ("max_gather_ms", 50, {"gather_ms": 51, "latency_budget_ms": 200}, "gather_ms"),
        (
            "max_hypotheses",
            9,
            {"defense": {"kind": "sample_consensus", "sampling_budget": 10}},
            "defense.sampling_budget",
        ),
        ("max_hypotheses", 6, {"defense": {"kind": "group_testing", "first_budget": 7}}, "defense.first_budget"),
    ],
)
async def test_what_exceeds_a_cap_is_refused_by_its_name(setting, most, request_, field):
    async with serve(**{setting: most}) as served:
        body = {"ego_id": EGO, "teammates": list(TEAM), **request_}
        refused = problem(await served.http.post("/v1/sessions", json=body), 422, "invalid-request")
        assert refused["field"] == field
        assert str(most) in refused["detail"]
        assert f"ROBOSAC_{setting.upper()}" in refused["detail"]


@pytest.mark.parametrize("request_", [{}, {"defense": {"kind": "group_testing"}}])
async def test_a_cap_on_hypotheses_lowers_what_a_session_leaves_open(request_):
    async with serve(max_hypotheses=3) as served:
        opened = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": list(TEAM), **request_})
        assert opened.status_code == 201, opened.text
        defense = opened.json()["defense"]
        assert (defense["kind"], defense["first_budget"], defense["budget"]) == ("group_testing", 3, 3)


async def test_a_frame_tests_no_more_hypotheses_than_allowed(messages):
    async with serve(extra_detectors=COUNTING, extra_defenses=MANY, max_hypotheses=10) as served:
        session = await served.client.open_session(EGO, MY_TEAM, defense=LONG, latency_budget_ms=20_000)
        answer = await served.ego(session).post_frame(0, messages[EGO], dict.fromkeys(MY_TEAM, messages["rsu"]))
        assert (answer.sampling_steps, answer.degraded_by) == (10, "deadline")


async def test_a_key_has_only_so_many_sessions_and_another_has_its_own():
    async with serve(api_keys="a" * 20 + "," + "b" * 20, max_sessions_per_key=3) as served:

        async def opened(key):
            body = {"ego_id": EGO, "teammates": ["rsu"]}
            return await served.http.post("/v1/sessions", json=body, headers={"Authorization": f"Bearer {key * 20}"})

        for _ in range(3):
            assert (await opened("a")).status_code == 201
        refused = problem(await opened("a"), 503, "too-many-sessions")
        assert "ROBOSAC_MAX_SESSIONS_PER_KEY" in refused["detail"]
        assert (await opened("b")).status_code == 201


async def test_no_more_sessions_are_opened_at_once_than_there_may_be():
    async with serve(api_keys="a" * 20, max_sessions_per_key=3) as served:
        body, headers = {"ego_id": EGO, "teammates": ["rsu"]}, {"Authorization": f"Bearer {'a' * 20}"}
        asked = (served.http.post("/v1/sessions", json=body, headers=headers) for _ in range(20))
        assert Counter(answer.status_code for answer in await asyncio.gather(*asked)) == {201: 3, 503: 17}


async def test_a_key_keeps_only_so_much_whether_its_sessions_have_ended_or_not(messages, benign):
    async with serve(api_keys="a" * 20 + "," + "b" * 20, audit_max_bytes_per_key=2**20) as served:
        long_record = {"kind": "conformal", "calibration": [i / 1999 for i in range(2000)]}

        async def opened(key, **more):
            body = {"ego_id": EGO, "teammates": ["rsu"], **more}
            return await served.http.post("/v1/sessions", json=body, headers={"Authorization": f"Bearer {key * 20}"})

        going_on, ended = (await opened("a")).json(), 0
        while (answer := await opened("a", defense=long_record)).status_code == 201:
            assert ended < 100
            mine = {"Authorization": f"Bearer {answer.json()['ego_token']}"}
            await served.http.delete(f"/v1/sessions/{answer.json()['session_id']}", headers=mine)
            ended += 1
        assert "ROBOSAC_AUDIT_MAX_BYTES_PER_KEY" in problem(answer, 507, "key-full")["detail"]
        mine = {"Authorization": f"Bearer {going_on['ego_token']}"}
        path = f"/v1/sessions/{going_on['session_id']}/teammates"
        problem(await served.http.post(path, json={"teammates": ["car-9"]}, headers=mine), 507, "key-full")
        assert (await opened("b")).status_code == 201
        ego = served.ego(SessionCreated.model_validate(going_on))
        frame = await ego.post_frame(0, messages[EGO], {"rsu": benign["rsu"]})
        assert frame.source == "consensus"
        await served.gateway.store.purge(time.time() + 1)
        await served.gateway.sessions.quota.look(served.gateway.store)
        assert (await opened("a")).status_code == 201


async def test_a_frame_number_does_not_leap(messages, benign):
    async with serve(max_frame_jump=100) as served:
        session = await served.open(gather_ms=20)
        ego = served.ego(session)
        await ego.post_frame(10**9, messages[EGO], benign)
        with pytest.raises(Exception, match="ROBOSAC_MAX_FRAME_JUMP"):
            await ego.post_frame(10**9 + 101, messages[EGO], benign)
        with pytest.raises(Exception, match="ROBOSAC_MAX_FRAME_JUMP"):
            await served.teammate(session, "rsu").send(10**9 + 101, messages["rsu"])
        assert (await ego.post_frame(10**9 + 100, messages[EGO], benign)).source == "consensus"


async def test_readiness_asks_the_database(served):
    assert (await served.http.get("/readyz")).status_code == 200
    stall = asyncio.create_task(served.gateway.store._database.write(lambda _: time.sleep(1.3)))
    await asyncio.sleep(0.01)
    began = time.perf_counter()
    problem(await served.http.get("/readyz"), 503, "not-ready")
    assert time.perf_counter() - began < 1.25
    await stall
    assert (await served.http.get("/readyz")).status_code == 200
