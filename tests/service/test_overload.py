import asyncio
import math
import time
from contextlib import ExitStack, suppress

import pytest

from robosac import wire
from service.arriving.checking import InFrame
from service.arriving.doors import capacity_check
from service.deciding import admission as admission_module
from service.deciding.admission import (
    COMING_S,
    DOUBT_S,
    KEY_FRAMES,
    MARGIN_S,
    SESSION_FRAMES,
    SESSIONS_KNOWN,
    Admission,
)
from service.engine import Engine
from service.errors import Kind, Refused
from service.jobs import Job
from service.turns import Turns, Work
from tests.service.conftest import EGO, problem, serve, until
from tests.service.credentials import KEY, OTHER_KEY


def due(left_s):
    return time.perf_counter() + left_s


class Clock:
    """Time that goes on as it does, and jumps."""

    ahead_s = 0.0

    def perf_counter(self):
        return time.perf_counter() + self.ahead_s


def taking(admission, key, session_id, left_s):
    """Take a frame on that has so much time left."""
    return admission.frame(key, session_id, due(left_s), left_s)


def test_frames_are_admitted_as_long_as_they_can_be_answered_in_time():
    admission = Admission()
    for _ in range(200):
        admission.learn("any", 0.010, 0.002, 0.001)
    taken = []

    def take_on_until_refused():
        for number in range(100):
            block = taking(admission, "", f"session {number}", 0.2)
            block.__enter__()
            taken.append(block)

    with pytest.raises(Refused) as refused:
        take_on_until_refused()
    assert 9 <= len(taken) <= 10  # 0.5 x (200 - 10 - 2) ms / 10 ms, and itself
    assert refused.value.kind is Kind.OVERLOADED
    assert refused.value.retry_after_s >= 1
    with taking(admission, "", "more time", 20.0):
        pass
    taken.pop().__exit__(None, None, None)
    with taking(admission, "", "again", 0.2):
        pass


def test_how_slowly_one_session_sends_is_no_matter_of_others():
    admission = Admission()
    for _ in range(20):
        admission.learn("slow", 0.010, 0.180, 0.001)
    admission.learn("known", 0.010, 0.002, 0.001)
    for session_id in ("known", "new"):
        with taking(admission, "", "another", 0.2), taking(admission, "", session_id, 0.2):
            pass
    with taking(admission, "", "another", 0.2), pytest.raises(Refused), taking(admission, "", "slow", 0.2):
        pass


def test_a_frame_that_cannot_be_in_time_anyway_is_admitted_if_nothing_else_is_in_hand():
    admission = Admission()
    for _ in range(200):
        admission.learn("any", 1.0, 0.002, 0.001)
    with taking(admission, "", "slow", 0.1), pytest.raises(Refused):
        admission.check("", "other", due(0.1))


async def test_no_ego_takes_the_share_of_the_others(served, good_frame, messages, benign):
    greedy, modest = await served.open(), await served.open()
    posts = [served.post(greedy, "frames", good_frame(frame)) for frame in range(SESSION_FRAMES + 4)]
    *answers, answer = await asyncio.gather(*posts, served.ego(modest).post_frame(0, messages[EGO], benign))
    refused = [response for response in answers if response.status_code != 200]
    assert len(refused) >= 4
    for response in refused:
        problem(response, response.status_code, "overloaded" if response.status_code == 503 else "stale-frame")
    assert any(response.status_code == 503 for response in refused)
    assert answer.source == "consensus"


async def test_beyond_capacity_a_frame_is_refused_before_it_is_read(served, good_frame):
    session = await served.open(latency_budget_ms=200.0, gather_ms=0)
    admission = served.gateway.admission
    for _ in range(200):
        admission.learn("any", 0.1, 0.0, 0.0)

    async def unread():
        pytest.fail("the body was read")
        yield b""

    with taking(admission, "", "another", 10.0), taking(admission, "", "a third", 10.0):
        refused = await served.post(session, "frames", unread(), token="not even looked at")
        assert refused.headers["retry-after"]
        problem(refused, 503, "overloaded")
    assert (await served.post(session, "frames", good_frame(0))).status_code == 200


async def test_a_frame_that_waited_long_to_be_seen_has_less_time():
    async with serve() as served:
        session = await served.open(latency_budget_ms=200.0, gather_ms=0)
        admission = served.gateway.admission
        for _ in range(200):
            admission.learn("any", 0.02, 0.0, 0.0)
        check = capacity_check(admission, served.gateway.sessions.in_use)
        scope = {"type": "http", "method": "POST", "path": f"/v1/sessions/{session.session_id}/frames", "state": {}}
        with taking(admission, "", "another", 10.0):
            check(scope)
            with pytest.raises(Refused, match="more frames in hand"):
                check(scope | {"robosac.arrived": time.perf_counter() - 0.16})


async def test_no_more_frames_are_read_at_a_time_than_can_be_answered(served, good_frame, monkeypatch):
    """All come at once, before any of them is in hand."""
    monkeypatch.setattr(admission_module, "COMING_S", 60.0)
    sessions = [await served.open(latency_budget_ms=200.0, gather_ms=0) for _ in range(12)]
    asked_for = answered = 0

    async def reading(body):
        nonlocal asked_for
        asked_for += 1
        await until(lambda: asked_for + answered >= len(sessions))
        yield body

    async def post(session, body):
        nonlocal answered
        answer = await served.post(session, "frames", reading(body))
        answered += 1
        return answer

    for session in sessions:
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
    for _ in range(200):
        served.gateway.admission.learn("any", 0.03, 0.0, 0.0)
    for frame in (1, 2):  # frames that came before change nothing
        asked_for, answered, body = 0, 0, good_frame(frame)
        answers = await asyncio.gather(*(post(session, body) for session in sessions))
        refused = [answer for answer in answers if answer.status_code == 503]
        assert 1 <= asked_for <= 6
        assert len(refused) >= len(sessions) - asked_for
        for answer in refused:
            problem(answer, 503, "overloaded")


@pytest.mark.parametrize("path", ["frames", "messages"])
async def test_a_frame_is_wanted_from_its_head_on_while_it_comes_and_while_it_is_read(
    path, messages, good_frame, monkeypatch
):
    """A body that takes long to come counts for a moment only."""
    monkeypatch.setattr(admission_module, "COMING_S", 60.0)
    clock, wanted = Clock(), {}
    monkeypatch.setattr(admission_module, "time", clock)
    async with serve(api_keys=f"{KEY},{OTHER_KEY}", api_key=KEY) as served:
        session = await served.open(latency_budget_ms=10_000.0)
        live, admission = served.gateway.sessions.in_use(session.session_id), served.gateway.admission
        authenticate = type(served.gateway.sessions).authenticate

        def note(when):
            wanted[when] = list(admission.wanted_by())

        async def noting(*given):
            note("at its head")
            clock.ahead_s += 45.0
            return await authenticate(*given)

        async def slowly():
            clock.ahead_s += 30.0
            note("as it comes")
            clock.ahead_s += 90.0
            note("later")
            yield body

        def read(caller, body):
            note("as it is read")
            yield
            raise InFrame(wire.WireError("malformed-msgpack", "", "it is read"), None)

        monkeypatch.setattr(type(served.gateway.sessions), "authenticate", noting)
        for name in ("read_frame", "read_message"):
            monkeypatch.setattr(f"service.arriving.frames.{name}", read)
        if path == "frames":
            body, token = good_frame(0), session.ego_token
        else:
            body, token = wire.pack_message(0, "rsu", messages["rsu"]), session.teammate_tokens["rsu"]
        problem(await served.post(session, path, slowly(), token), 400, "malformed-msgpack")
        clock.ahead_s += 90.0
        note("at last")
    assert {when for when, keys in wanted.items() if set(keys) == {(live.key, session.session_id)}} == {
        "at its head",
        "as it comes",
        "as it is read",
    }
    assert wanted["later"] == wanted["at last"] == []


def test_a_body_that_takes_long_hides_none_that_comes_after_it():
    admission = of_80_ms()
    with admission.coming("key", "slow", due(10.0)):
        time.sleep(COMING_S)
        with admission.coming("key", "one", due(0.2)), pytest.raises(Refused):
            admission.check("key", "two", due(0.2))


def test_a_key_has_so_many_frames_in_hand_and_no_more():
    """However much time they have: whoever sends next pays for finding out whose turn it is."""
    admission = Admission(key_frames=KEY_FRAMES)
    with ExitStack() as taken:
        for number in range(KEY_FRAMES - 2):
            taken.enter_context(taking(admission, "many", f"session {number}", 1e4))
        for number in (1, 2):
            taken.enter_context(admission.coming("many", f"that comes {number}", due(1e4)))
        for _ in range(3):
            with pytest.raises(Refused, match=f"{KEY_FRAMES} frames of this API key") as refused:
                taken.enter_context(admission.coming("many", "one more", due(1e4)))
            assert refused.value.kind is Kind.OVERLOADED
        admission.check("another", "its session", due(1e4))
        with taking(admission, "many", "that comes 1", 1e4), taking(admission, "many", "that comes 2", 1e4):
            with pytest.raises(Refused), taking(admission, "many", "one more", 1e4):
                pass
            with taking(admission, "another", "its session", 1e4):
                pass
    admission.check("many", "one more", due(1e4))


@pytest.mark.parametrize("keys", [("one",), ("one", "another")])
async def test_one_key_has_all_to_itself_where_there_is_no_other(keys):
    async with serve(api_keys=",".join(f"a-long-key-of-{key}" for key in keys)) as served:
        admission = served.gateway.admission
        with ExitStack() as taken:
            for number in range(KEY_FRAMES):
                taken.enter_context(taking(admission, "key", f"session {number}", 1e4))
            if len(keys) == 1:
                admission.check("key", "one more", due(1e4))
            else:
                with pytest.raises(Refused):
                    admission.check("key", "one more", due(1e4))


def of_80_ms():
    """An admission that knows frames of so long."""
    admission = Admission()
    for _ in range(200):
        admission.learn("any", 0.08, 0.0, 0.0)
    return admission


def test_a_frame_that_is_to_be_read_counts_for_others_of_its_key():
    admission = of_80_ms()
    with admission.coming("key", "one", due(0.2)) as expected:
        admission.check("another", "its session", due(0.2))
        with taking(admission, "key", "whose body is there", 0.2):
            pass
        for check in (admission.check, lambda *frame: admission.coming(*frame).__enter__()):
            with pytest.raises(Refused, match="more frames in hand"):
                check("key", "two", due(0.2))
        expected.over = True
        admission.check("key", "two", due(0.2))
    admission.check("key", "two", due(0.2))


def test_a_frame_that_is_to_be_read_counts_for_a_moment_and_once_a_session():
    admission = of_80_ms()
    with ExitStack() as coming:
        for _ in range(50):
            coming.enter_context(admission.coming("key", "one", due(10.0)))
        admission.check("key", "two", due(0.3))  # .08 s of .22 that it can spare: of two there would be too much
        with pytest.raises(Refused):
            admission.check("key", "two", due(0.2))
        time.sleep(COMING_S)
        admission.check("key", "two", due(0.2))
        coming.enter_context(admission.coming("key", "one", due(10.0)))  # still for the first of them
        admission.check("key", "two", due(0.2))


@pytest.mark.parametrize(
    ("ended_by", "counts_again"),
    [
        (None, False),
        (ConnectionResetError(), False),
        (Refused(Kind.SLOW_BODY, "too slow"), False),
        (Refused(Kind.OVERLOADED, "no room"), True),
        ("it came", True),
    ],
)
def test_who_is_waited_for_in_vain_is_not_waited_for_again(ended_by, counts_again, monkeypatch):
    def counts():
        with admission.coming("key", "one", due(0.2)):
            try:
                admission.check("key", "two", due(0.2))
            except Refused:
                return True
            return False

    admission = of_80_ms()
    with suppress(ConnectionResetError, Refused), admission.coming("key", "one", due(0.2)) as expected:
        expected.over = ended_by == "it came"
        if isinstance(ended_by, Exception):
            raise ended_by
    assert counts() is counts_again
    later = time.perf_counter() + DOUBT_S
    monkeypatch.setattr(time, "perf_counter", lambda: later)
    assert counts()


def test_of_whom_was_waited_in_vain_for_not_all_are_remembered():
    admission = Admission()
    for number in range(SESSIONS_KNOWN + 10):
        with admission.coming("key", f"session {number}", due(0.2)):
            pass
    assert len(admission._doubted) == SESSIONS_KNOWN


async def test_a_slow_body_is_cut_off(messages, benign):
    async with serve(body_timeout_s=0.3) as served:
        session = await served.open()
        body = wire.pack_frame(0, messages[EGO], benign)

        async def dripping():
            yield body[:1000]
            for i in range(1000, 1200):
                await asyncio.sleep(0.1)
                yield body[i : i + 1]

        refused = await served.post(session, "frames", dripping())
        assert problem(refused, 408, "slow-body")["detail"]
        (record,) = [r for r in await served.ego(session).audit() if r["event"] == "message_refused"]
        assert "in time" in record["detail"]
        assert (await served.ego(session).post_frame(0, messages[EGO], benign)).source == "consensus"
        opening = await served.http.post(
            "/v1/sessions", content=dripping(), headers={"content-type": "application/json"}
        )
        problem(opening, 408, "slow-body")


@pytest.mark.parametrize("length", [None, "0", "+5", "1e9"])
async def test_a_body_is_bounded_whatever_its_headers_say(length):
    """Servers refuse such headers themselves; nothing here rests on it."""

    async def dripping():
        for _ in range(30):
            yield b" "
            await asyncio.sleep(0.05)

    async def call(served, body):
        headers = {"content-type": "application/json"} | ({} if length is None else {"content-length": length})
        return await served.http.post("/v1/sessions", content=body, headers=headers)

    async with serve(body_timeout_s=0.2) as served:
        problem(await call(served, dripping()), 408, "slow-body")
    async with serve(max_body_bytes=2048) as served:
        problem(await call(served, _endless()), 413, "too-large")


async def _endless():
    for _ in range(1000):
        yield bytes(1024)


async def test_opening_sessions_costs_little_and_ends_at_the_limit():
    async with serve(max_sessions=300) as served:
        for number in range(300):
            await served.client.open_session(f"car-{number}", ["rsu"])
        body = {"ego_id": "one-more", "teammates": ["rsu"]}
        problem(await served.http.post("/v1/sessions", json=body), 503, "too-many-sessions")


def test_a_short_frame_is_not_refused_for_a_long_one():
    admission = Admission()
    for _ in range(20):
        admission.learn("long", 10.0, 0.002, 0.001)
        admission.learn("short", 0.05, 0.002, 0.001)
    with taking(admission, "key", "long", 60.0):
        admission.check("key", "short", due(0.06))
    with taking(admission, "key", "short", 0.06):
        admission.check("key", "long", due(60.0))


def test_many_sessions_of_a_key_add_no_more_to_a_frame_of_another_than_one_of_them():
    admission = Admission()
    for _ in range(200):
        admission.learn("any", 0.05, 0.002, 0.001)
    with ExitStack() as taken:
        for number in range(12):
            taken.enter_context(taking(admission, "many", f"session {number}", 20.0))
        admission.check("one", "its session", due(0.16))
        with pytest.raises(Refused):
            admission.check("many", "one more", due(0.2))


@pytest.mark.parametrize("led_by_s", [0.0, MARGIN_S + 0.01])
def test_a_frame_in_hand_is_made_late_only_by_who_had_much_less(led_by_s):
    turns = Turns()
    for key, had_s in (("modest", 0.01), ("greedy", 0.01 + led_by_s)):
        work = Work(key, "its session", math.inf, 0.01)
        turns.add(work)
        turns.charge(work, had_s)
        turns.remove(work)
    admission = Admission(turns=turns)
    for _ in range(200):
        admission.learn("short", 0.04, 0.0, 0.0)
        admission.learn("long", 0.05, 0.0, 0.0)
    with taking(admission, "greedy", "long", 0.08):
        if led_by_s:
            admission.check("modest", "short", due(20.0))
        else:
            with pytest.raises(Refused, match="would be answered late for it"):
                admission.check("modest", "short", due(20.0))


def test_who_had_less_than_the_others_is_admitted_beside_them():
    """It goes first on the thread; and the other way round."""
    turns = Turns()
    for key, had_s in (("modest", 0.01), ("greedy", 0.1)):
        work = Work(key, "its session", math.inf, 0.05)
        turns.add(work)
        turns.charge(work, had_s)
        turns.remove(work)
    admission = Admission(turns=turns)
    for _ in range(200):
        admission.learn("any", 0.05, 0.002, 0.001)
    with taking(admission, "greedy", "one", 20.0):
        admission.check("modest", "its session", due(0.06))
        admission.check("modest", "its session", due(0.01))  # late by itself, and by nobody's fault
    with taking(admission, "modest", "its session", 0.2), pytest.raises(Refused):
        admission.check("greedy", "one", due(0.1))


def test_a_frame_that_waits_for_its_teammates_costs_the_others_nothing():
    admission = Admission()
    with ExitStack() as taken:
        for number in range(100):
            taken.enter_context(admission.waiting(f"session {number}"))
        admission.check("", "another", due(0.05))
    for _ in range(SESSION_FRAMES):
        taken.enter_context(admission.waiting("greedy"))
    with pytest.raises(Refused):
        admission.check("", "greedy", due(20.0))


def test_one_stall_teaches_nothing():
    admission = Admission()
    for number in range(20):
        stalled = number == 15
        admission.learn("any", *((0.9, 5.0, 5.0) if stalled else (0.01, 0.002, 0.001)))
    with taking(admission, "", "one", 0.2):
        admission.check("", "any", due(0.1))
    with admission.frame("", "one", 100.0, 0.2) as work:
        assert work.due == pytest.approx(99.999)


class Slow:
    """A session whose frames take so many steps of sleep."""

    def __init__(self, steps, step_s):
        self._steps, self._step_s = steps, step_s

    def decide_in_steps(self, *_, **__):
        for _ in range(self._steps):
            time.sleep(self._step_s)
            yield
        return "decided"


async def test_a_frame_that_others_held_up_until_it_cannot_be_in_time_is_refused_before_it_is_begun():
    engine = Engine(1)
    try:
        dear = Work("dear", "s", math.inf, expected_s=0.05)
        first = asyncio.create_task(engine.decide(Slow(15, 0.02), 0, None, {}, 0, None, work=dear))
        await asyncio.sleep(0)
        late = Work("late", "s", time.perf_counter() + 0.12, expected_s=0.1)
        with pytest.raises(Refused, match="the time that this one had") as refused:
            await engine.decide(Slow(5, 0.02), 0, None, {}, 0, None, work=late)
        assert refused.value.kind is Kind.OVERLOADED
        assert late.had_s == 0
        assert (await first).result == "decided"
        nobodys_fault = Work("alone", "s", time.perf_counter() + 0.01, expected_s=0.1)
        assert (await engine.decide(Slow(2, 0.02), 0, None, {}, 0, None, work=nobodys_fault)).result == "decided"
    finally:
        engine.stop()


async def test_work_may_be_asked_for_anew_as_soon_as_it_is_decided(monkeypatch):
    """As where the session changed meanwhile: the engine is done with it then, however slowly it goes on."""
    step = Job.step

    def slow(job):
        goes_on = step(job)
        if not goes_on:
            time.sleep(0.05)
        return goes_on

    monkeypatch.setattr(Job, "step", slow)
    engine, work = Engine(1), Work("key", "s", math.inf, 0.0)
    try:
        for _ in range(3):
            again = engine.decide(Slow(2, 0.0), 0, None, {}, 0, None, work=work)
            assert (await asyncio.wait_for(again, 5)).result == "decided"
            assert work.over
        failing = engine.decide(Failing(), 0, None, {}, 0, None, work=work)
        with pytest.raises(ZeroDivisionError):
            await asyncio.wait_for(failing, 5)
        again = engine.decide(Slow(2, 0.0), 0, None, {}, 0, None, work=work)
        assert (await asyncio.wait_for(again, 5)).result == "decided"
    finally:
        engine.stop()


class Failing:
    """A session whose frames cannot be decided."""

    def decide_in_steps(self, *_, **__):
        yield
        raise ZeroDivisionError
