"""The event loop's time is shared: whoever took more than others lately is read from later."""

import asyncio
import contextlib
import itertools
import logging
import socket
import time
from types import SimpleNamespace

import pytest
import uvicorn
import uvloop

from service.arriving.arrival import Arrival, arrival_of
from service.arriving.connections import _CREDENTIAL, PIPELINED, BoundedHTTP
from service.arriving.metering import METER, Metered
from service.arriving.pacing import (
    LATELY_S,
    LIMIT,
    LIMIT_GREEDY,
    LOOKED_AT,
    MOST_KEPT_BYTES,
    OF_OTHERS,
    OTHERS,
    SLACK,
    Pacing,
)
from service.arriving.parties import Parties
from service.callers import _SCHEMES
from service.watching.stalls import LoopWatch
from tests.service.conftest import serve
from tests.service.credentials import KEY, OTHER_KEY

GREEDY, MODEST = ("key greedy", "ego"), ("key modest", "ego")
STRANGER = (OTHERS, "address 10.0.0.1")
WAIT_S = 0.3
GET_WORK = b"GET /work HTTP/1.1\r\nHost: x\r\n\r\n"
KEEP_ALIVE_S = 1


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def paced(busy=False):
    clock = Clock()
    return Pacing(lambda scope: STRANGER, lambda: [("a", "ego")] if busy else [], clock), clock


def spend(pacing, clock, seconds=0.5, **share):
    """Let parties, each in a session of its own name, have parts of the time for a while."""
    for _ in range(int(seconds * 1000)):
        clock.now += 0.001
        for key, part in share.items():
            pacing.charge(tuple(key.split("_")), 0.001 * part)


def over(pacing, *names):
    return [name for name in names if pacing.is_over(tuple(name.split("_")))]


def test_nobody_waits_while_there_is_time():
    pacing, clock = paced()
    spend(pacing, clock, a_ego=0.9 * LIMIT)
    assert not over(pacing, "a_ego", "b_ego")


def test_whoever_had_more_than_an_equal_part_waits_until_there_is_time():
    pacing, clock = paced()
    spend(pacing, clock, a_ego=0.9, b_ego=0.05)
    assert over(pacing, "a_ego", "b_ego", "never_seen") == ["a_ego"]
    clock.now += 2 * LATELY_S
    assert not over(pacing, "a_ego")


def test_those_who_all_want_as_much_do_not_wait():
    pacing, clock = paced(busy=True)
    spend(pacing, clock, a_ego=0.4 * LIMIT, a_mate=0.45 * LIMIT, b_ego=0.9 * LIMIT)
    assert not over(pacing, "a_ego", "a_mate", "b_ego")


def test_a_member_of_a_key_waits_for_its_own_part_only():
    pacing, clock = paced()
    spend(pacing, clock, a_mate=0.9, a_ego=0.02, b_ego=0.02)
    assert over(pacing, "a_mate", "a_ego", "b_ego") == ["a_mate"]


def test_there_is_less_time_for_whoever_had_much_more_than_one_whose_frames_are_in_hand():
    part = (LIMIT + LIMIT_GREEDY) / 2
    for busy in (False, True):
        pacing, clock = paced(busy)
        spend(pacing, clock, 2.0, b_ego=part, a_ego=0.8 * part / SLACK)
        assert pacing.is_over(("b", "ego")) is busy
        pacing, clock = paced(busy)
        spend(pacing, clock, 2.0, b_ego=part, a_ego=1.25 * part / SLACK)
        assert not pacing.is_over(("b", "ego"))


def test_what_comes_in_a_burst_makes_nobody_greedy():
    """Frames of two keys, by turns: one has just had all of the time, and the other before it."""
    pacing, clock = paced(busy=True)
    for _ in range(5):
        for key in ("a", "b"):
            spend(pacing, clock, 0.02, **{f"{key}_ego": 1.0})
            spend(pacing, clock, 0.08)
    clock.now -= 0.08
    assert not pacing.is_over(("b", "ego"))


@pytest.mark.parametrize(("members", "busy"), [(1, False), (8, False), (1, True), (8, True), (50, True)])
def test_many_who_go_on_one_after_the_other_have_no_more_than_one(members, busy):
    """Each waits once it had a turn, and would have none of the time soon after."""
    pacing, clock = paced(busy)
    waiting, had_s, turn_s = [f"{number}" for number in range(members)], 0.0, 0.005
    while clock.now < 2.0:
        pacing.charge(("a", "ego"), 0.0001)
        for member in list(waiting):
            if not pacing.is_over(("b", member)):
                waiting.append(waiting.pop(waiting.index(member)))
                pacing.charge(("b", member), turn_s)
                clock.now += turn_s
                had_s += turn_s
                break
        clock.now += 0.002
    assert had_s / clock.now < (SLACK * LIMIT_GREEDY if busy else LIMIT) + 0.12


@pytest.mark.parametrize("busy", [False, True])
def test_there_is_less_time_for_a_session_that_had_much_more_than_another_of_its_key(busy):
    pacing, clock = paced(busy)
    spend(pacing, clock, a_ego_car=0.05, a_bad_car=0.2, a_bad_mate=0.2, a_other_car=0.05)
    assert over(pacing, "a_ego_car", "a_bad_car", "a_bad_mate", "a_other_car") == ["a_bad_car", "a_bad_mate"] * busy


@pytest.mark.parametrize("busy", [False, True])
def test_there_is_less_time_for_a_vehicle_that_had_much_more_than_others_of_its_session(busy):
    pacing, clock = paced(busy)
    spend(pacing, clock, a_ego_car=0.05, a_ego_bad=0.4, a_ego_mate=0.05)
    assert over(pacing, "a_ego_car", "a_ego_bad", "a_ego_mate") == ["a_ego_bad"] * busy


def test_whoever_has_frames_in_hand_and_sends_little_makes_nobody_wait_who_sends_little_more():
    """A frame may have a budget of a minute. An honest ego's messages come in a burst."""
    pacing, clock = paced(busy=True)
    spend(pacing, clock, b_ego=0.9 * LIMIT_GREEDY)
    spend(pacing, clock, 0.04, b_ego=0.9 * LIMIT)
    assert not over(pacing, "b_ego")


@pytest.mark.parametrize("worked", [0.3, 0.4])
def test_whoever_has_many_frames_decided_does_not_wait_for_those_of_who_sends_little(worked):
    pacing, clock = paced(busy=True)
    for _ in range(1000):
        spend(pacing, clock, 0.002, a_ego_car=0.01, b_ego_car=0.35, b_ego_mate=0.001)
        pacing.worked(("b", "ego", "car"), worked * 0.002)
    assert pacing.is_over(("b", "ego", "car")) is (worked < 0.351)


def test_whoever_has_frames_of_many_sessions_hides_no_other_among_them():
    clock = Clock()
    wanted = [*(("b", f"{number}") for number in range(200)), ("a", "ego")]
    pacing = Pacing(lambda scope: STRANGER, lambda: wanted, clock)
    spend(pacing, clock, a_ego=0.01, **{f"b_{number}": 0.4 / 200 for number in range(200)})
    assert pacing.is_over(("b", "0"))


def test_one_that_is_alone_waits_for_nobody():
    pacing, clock = paced(busy=True)
    spend(pacing, clock, a_ego_car=0.95)
    assert not over(pacing, "a_ego_car")


def test_all_without_a_credential_have_one_small_part():
    pacing, clock = paced()
    shares = {f"{OTHERS}_{number}": 1.5 * SLACK * LIMIT * OF_OTHERS / 10 for number in range(10)}
    spend(pacing, clock, a_ego=LIMIT * 0.8, **shares)
    assert len(over(pacing, *shares)) == 10
    assert not over(pacing, "a_ego")


def test_parties_are_forgotten_that_were_away():
    pacing, clock = paced()
    for number in range(20_000):
        clock.now += 0.01
        pacing.charge((f"key {number % 300}", f"{number}"), 0.001)
    assert len(pacing._had) <= 202
    assert sum(pacing._members.values()) == len(pacing._had)


class Connection:
    is_gone = False

    def __init__(self, party, gone_on):
        self.party, self._gone_on = party, gone_on

    def go_on(self, pacing):
        self._gone_on.append(self.party)


async def test_who_had_least_goes_on_first_and_all_do():
    gone_on = []
    pacing = Pacing(lambda scope: STRANGER, lambda: [])
    for party, seconds in ((GREEDY, 0.3), (MODEST, 0.01), (STRANGER, 0.1)):
        pacing.charge(party, seconds)
    for party in (GREEDY, STRANGER, GREEDY, MODEST):
        assert pacing.wait(Connection(party, gone_on), 1)
    async with asyncio.timeout(5.0):
        while len(gone_on) < 4:
            await asyncio.sleep(0.001)
    assert gone_on == [MODEST, STRANGER, GREEDY, GREEDY]


async def in_order(pacing, *parties):
    """In which order those go on of whom something waits, once all have."""
    gone_on = []
    for party in parties:
        assert pacing.wait(Connection(party, gone_on), 1)
    async with asyncio.timeout(10.0):
        while len(gone_on) < len(parties):
            await asyncio.sleep(0.001)
    return gone_on


async def test_whoever_is_over_its_part_holds_up_nobody_who_is_not():
    """A stranger's part is small, so that it may be over with less than somebody else has who is not."""
    pacing = Pacing(lambda scope: STRANGER, lambda: [("another", "session")])
    pacing.charge(MODEST, 0.02)
    pacing.charge(STRANGER, 0.015)
    assert pacing.is_over(STRANGER)
    assert not pacing.is_over(MODEST)
    assert await in_order(pacing, STRANGER, MODEST) == [MODEST, STRANGER]


async def test_who_had_least_of_its_part_goes_before_who_had_least():
    pacing = Pacing(lambda scope: STRANGER, lambda: [])
    pacing.charge(STRANGER, 0.001)
    pacing.charge(MODEST, 0.002)
    assert await in_order(pacing, STRANGER, MODEST) == [MODEST, STRANGER]


async def test_a_member_that_is_over_its_part_holds_up_no_other():
    pacing = Pacing(lambda scope: STRANGER, lambda: [("another", "session")])
    other = (OTHERS, "address 10.0.0.2")
    pacing.charge(MODEST, 0.02)
    pacing.charge(other, 0.0001)
    pacing.charge(STRANGER, 0.004)
    assert await in_order(pacing, STRANGER, other) == [other, STRANGER]


@pytest.mark.parametrize("addresses", [1, 3000])
async def test_a_crowd_of_strangers_does_not_go_before_a_key(addresses):
    gone_on, pacing = [], Pacing(lambda scope: STRANGER, lambda: [("another", "session")])
    pacing.charge(MODEST, 0.15)
    assert pacing.is_over(MODEST)
    for number in range(6000):
        assert pacing.wait(Connection((OTHERS, f"address {number % addresses}"), gone_on), 1)
    turn = asyncio.create_task(pacing.turn(MODEST))
    while pacing.is_over(MODEST):
        await asyncio.sleep(0.001)
    before = len(gone_on)
    await asyncio.wait_for(turn, 10.0)
    assert len(gone_on) - before <= 64 * 3


@pytest.mark.parametrize(("reading_takes_s", "expected"), [(0.0, LOOKED_AT), (1.0, 1)])
async def test_things_of_several_members_go_on_at_once_while_there_is_time(reading_takes_s, expected):
    """Each reading of the clock takes so long."""
    readings, gone_on = itertools.count(), []
    pacing = Pacing(lambda scope: STRANGER, lambda: [], lambda: next(readings) * reading_takes_s)
    for number in range(1000):
        assert pacing.wait(Connection((OTHERS, f"address {number}"), gone_on), 1)
    pacing._look.cancel()
    pacing._look_again()
    assert len(set(gone_on)) == len(gone_on) == expected
    pacing._look.cancel()


async def test_what_is_gone_takes_nobodys_place():
    gone_on, pacing = [], Pacing(lambda scope: STRANGER, lambda: [])
    for number in range(1001):
        connection = Connection(GREEDY, gone_on)
        connection.is_gone = number < 1000
        assert pacing.wait(connection, 1)
    pacing._look.cancel()
    pacing._look_again()
    assert gone_on == [GREEDY]
    assert (pacing._waiting, pacing._kept) == ({}, 0)


@pytest.mark.parametrize("scheme", [*_SCHEMES, "Bearer", "DPoP"])
def test_a_credential_is_seen_in_the_first_bytes_in_any_scheme_that_counts(scheme):
    head = f"POST /work HTTP/1.1\r\nHost: x\r\nAuthorization: {scheme} car\r\nContent-Length: 0\r\n\r\n"
    assert _CREDENTIAL.search(head.encode())[1] == f"{scheme} car".encode()


async def test_a_vehicle_is_the_same_party_with_a_new_token(served):
    session = await served.open()
    parties, vehicle = served.gateway.parties, served.ego(session)

    def party():
        headers = [(b"authorization", f"Bearer {vehicle.token}".encode())]
        return parties.of_loop({"client": ("10.0.0.1", 1), "headers": headers})

    before = party()
    old = vehicle.token
    await vehicle.renew()
    assert vehicle.token != old
    assert party() == before
    assert before[0] != OTHERS


async def test_what_waits_is_bounded():
    pacing = Pacing(lambda scope: STRANGER, lambda: [])
    gone_on = []
    assert pacing.wait(Connection(GREEDY, gone_on), MOST_KEPT_BYTES)
    assert not pacing.wait(Connection(MODEST, gone_on), 1)
    while not gone_on:
        await asyncio.sleep(0.001)
    assert pacing.wait(Connection(MODEST, gone_on), MOST_KEPT_BYTES)


class Told(Pacing):
    """Has those wait who show a certain credential, until it is told otherwise."""

    def __init__(self):
        super().__init__(self.by_credential, lambda: [])
        self.held, self.charged = {"greedy"}, {}

    def by_credential(self, scope):
        said = dict(scope["headers"]).get(b"authorization", b"Bearer nobody")
        return "key", said.decode().split(" ")[1]

    def is_over(self, party):
        return party[1] in self.held

    def charge(self, party, seconds):
        self.charged[party[1]] = self.charged.get(party[1], 0.0) + seconds


def burn(seconds):
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


async def application(scope, receive, send):
    if scope["type"] != "http":
        return
    waited_s = time.perf_counter() - arrival_of(scope)
    length = 0
    while scope["path"] != "/unread":
        message = await receive()
        length += len(message.get("body", b""))
        if not message.get("more_body"):
            break
    if scope["path"] == "/work":
        burn(0.02)
        await asyncio.sleep(WAIT_S)
        burn(0.02)
    if scope["path"] in ("/long", "/unread"):
        await asyncio.sleep(WAIT_S)
    body = b"%5.3f %8d" % (waited_s, length)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture
def pacing():
    return Told()


@contextlib.asynccontextmanager
async def serving(pacing):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        application_ = Arrival(Metered(application, pacing), LoopWatch())
        config = uvicorn.Config(application_, http=BoundedHTTP, log_config=None, timeout_keep_alive=KEEP_ALIVE_S)
        server = uvicorn.Server(config)
        running = asyncio.create_task(server.serve([listening]))
        while not server.started:
            await asyncio.sleep(0.005)
        yield listening.getsockname()[1]
        server.should_exit = True
        await running


@pytest.fixture
async def port(pacing):
    async with serving(pacing) as port:
        yield port


def request(who, path="/", body=b""):
    head = f"POST {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {who}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body


@contextlib.asynccontextmanager
async def connected(port):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    yield reader, writer
    writer.close()


async def answer(reader):
    """How long a request waited for the application, and how much of a body it saw."""
    assert b"200" in await reader.readuntil(b"\r\n\r\n")
    waited_s, length = (await reader.readexactly(14)).split()
    return float(waited_s), int(length)


@pytest.mark.parametrize("kept_alive", [False, True])
async def test_only_whoever_is_over_its_part_waits_and_its_time_runs(port, pacing, kept_alive):
    body = bytes(1_000_000)
    async with connected(port) as (reader, writer), connected(port) as (other, to_other):
        if kept_alive:
            pacing.held.clear()
            writer.write(request("greedy"))
            await answer(reader)
            pacing.held.add("greedy")
        writer.write(request("greedy", body=body) + request("greedy", body=body))
        waiting = asyncio.create_task(answer(reader))
        for _ in range(3):
            to_other.write(request("modest", body=body))
            waited_s, length = await answer(other)
            assert waited_s < WAIT_S / 2
            assert length == len(body)
        await asyncio.sleep(KEEP_ALIVE_S + WAIT_S)
        assert not waiting.done()
        pacing.held.clear()
        waited_s, length = await asyncio.wait_for(waiting, 5.0)
        assert waited_s >= WAIT_S
        assert length == len(body)
        assert (await answer(reader))[1] == len(body)
        await asyncio.sleep(WAIT_S)
        writer.write(request("greedy"))
        assert (await answer(reader))[0] < WAIT_S / 2


async def test_a_request_that_came_while_its_connection_waited_has_come_then(port, pacing):
    body = bytes(1000)
    async with connected(port) as (reader, writer):
        writer.write(request("greedy", body=body))
        await asyncio.sleep(WAIT_S / 2)
        writer.write(request("greedy", body=body))
        await asyncio.sleep(WAIT_S)
        pacing.held.clear()
        for least in (1.5 * WAIT_S, WAIT_S):
            waited_s, length = await answer(reader)
            assert length == len(body)
            assert waited_s >= least


async def test_what_the_end_of_a_body_waited_does_not_count_for_the_next_request(port, pacing):
    pacing.held.clear()
    async with connected(port) as (reader, writer):
        sent = request("greedy", body=bytes(1000))
        writer.write(sent[:-500])
        await asyncio.sleep(WAIT_S / 3)
        pacing.held.add("greedy")
        writer.write(sent[-500:])
        await asyncio.sleep(WAIT_S)
        pacing.held.clear()
        assert (await answer(reader))[0] < WAIT_S / 2
        writer.write(sent)
        assert (await answer(reader))[0] < WAIT_S / 2


async def test_the_loops_time_is_measured_and_no_other(port, pacing):
    async with connected(port) as (reader, writer):
        writer.write(request("busy", "/work"))
        await answer(reader)
        writer.write(request("idle", "/long"))
        await answer(reader)
    assert 0.04 <= pacing.charged["busy"] < 0.04 + WAIT_S / 2
    assert pacing.charged["idle"] < 0.02


def test_what_the_loop_does_between_is_put_down_to_whoever_comes_next():
    pacing = Told()
    burn(0.02)  # before anybody was there
    for who in ("greedy", "modest", "greedy"):
        pacing.had_since(("key", who))
        burn(0.02)
    assert pacing.charged["modest"] == pytest.approx(0.02, abs=0.01)
    assert pacing.charged["greedy"] == pytest.approx(0.02, abs=0.01)


async def test_connections_are_put_down_to_whose_they_are(port, pacing):
    async with connected(port) as (reader, writer):
        writer.write(request("modest"))
        await answer(reader)
        before = pacing.charged["modest"]
        del pacing.charged["nobody"]
    async with asyncio.timeout(10.0):
        while pacing.charged["modest"] == before:
            await asyncio.sleep(0.001)
    assert "nobody" not in pacing.charged


@pytest.mark.parametrize("refused", [False, True])
async def test_each_request_of_a_connection_is_put_down_to_its_own_sender(port, pacing, refused):
    """A proxy sends for many. An answer may come before the body does."""
    async with connected(port) as (reader, writer):
        sent = request("modest", "/unread" if refused else "/", bytes(1000))
        writer.write(sent[:-500])
        if refused:
            await answer(reader)
        writer.write(sent[-500:])
        if not refused:
            await answer(reader)
        await asyncio.sleep(0.05)
        writer.write(GET_WORK)
        await answer(reader)
    assert pacing.charged["modest"] < 0.03
    assert pacing.charged["nobody"] >= 0.04


async def test_whoever_has_too_much_waiting_is_hung_up_on(port, pacing, monkeypatch):
    monkeypatch.setattr("service.arriving.pacing.MOST_KEPT_BYTES", 0)
    async with connected(port) as (reader, writer):
        writer.write(request("greedy"))
        with contextlib.suppress(ConnectionError):
            assert await asyncio.wait_for(reader.read(-1), 5.0) == b""
    async with connected(port) as (reader, writer):
        writer.write(request("modest"))
        await answer(reader)


async def test_who_goes_away_while_it_waits_does_no_harm(port, pacing, caplog):
    async with connected(port) as (_, writer):
        writer.write(request("greedy"))
        await asyncio.sleep(0.05)
    async with connected(port) as (reader, writer):
        await asyncio.sleep(0.05)
        pacing.held.clear()
        writer.write(request("greedy"))
        await answer(reader)
    assert not [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


async def test_no_more_of_a_body_is_taken_than_before(port, pacing):
    async with connected(port) as (reader, writer):
        writer.write(request("greedy", "/unread", bytes(2**26)))
        await asyncio.sleep(WAIT_S / 2)
        pacing.held.clear()
        await answer(reader)
        assert writer.transport.get_write_buffer_size() > 2**25


def test_nothing_is_answered_on_a_connection_that_was_hung_up(pacing, caplog):
    async def hung_up():
        async with serving(pacing) as port, connected(port) as (reader, writer):
            writer.write(request("modest", "/long") * (PIPELINED + 3))
            with contextlib.suppress(ConnectionError):
                await asyncio.wait_for(reader.read(-1), 5.0)
            await asyncio.sleep(2 * WAIT_S)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:  # asyncio's own forgives it
        runner.run(hung_up())
    assert not [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


async def test_faults_and_cancelling_pass_through():
    seen = []

    async def failing(scope, receive, send):
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            seen.append("cancelled")
            raise
        finally:
            await asyncio.sleep(0)

    async def faulty(scope, receive, send):
        await asyncio.sleep(0)
        raise KeyError("fault")

    scope = {"type": "http", "state": {METER: SimpleNamespace(step=lambda: seen.append("step"))}}
    task = asyncio.create_task(Metered(failing, None)(scope, None, None))
    await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert "cancelled" in seen
    with pytest.raises(KeyError, match="fault"):
        await Metered(faulty, None)(scope, None, None)
    assert len(seen) >= 5


async def test_whatever_else_waits_goes_on_once_there_is_time_or_is_given_up():
    pacing, wrong = Pacing(lambda scope: STRANGER, lambda: []), []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: wrong.append(context))
    await pacing.turn(GREEDY)
    for party, seconds in ((GREEDY, 0.3), (MODEST, 0.01)):
        pacing.charge(party, seconds)
    given_up = asyncio.create_task(pacing.turn(GREEDY))
    turn = asyncio.create_task(pacing.turn(GREEDY))
    await asyncio.wait_for(pacing.turn(MODEST), 1.0)
    assert not turn.done()
    given_up.cancel()
    await asyncio.wait_for(turn, 10.0)
    assert not pacing.is_over(GREEDY)
    assert given_up.cancelled()
    assert not pacing._waiting
    assert not wrong


async def test_a_keys_own_frames_are_told_from_those_of_others(good_frame, monkeypatch):
    async with serve(api_keys=f"{KEY},{OTHER_KEY}", api_key=KEY) as served:
        gateway, worked = served.gateway, []
        monkeypatch.setattr(gateway.frames.reading.pacing, "worked", lambda *told: worked.append(told))
        session = await served.open()
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        parties = Parties(gateway.api_keys, gateway.viewer_tokens, gateway.store.seen, gateway.sessions.tokens.signed)

        def party_of(credential):
            headers = [(b"authorization", f"Bearer {credential}".encode())]
            return parties.of_loop({"client": ("10.0.0.1", 1), "headers": headers})

        [(worker, seconds)] = worked
        assert worker == party_of(session.ego_token)
        assert 0 < seconds < 60
        shown = (KEY, session.ego_token, session.teammate_tokens["rsu"])
        assert len({party_of(one)[0] for one in shown}) == 1
        assert len({party_of(one) for one in shown}) == 3
        assert len({party_of(one)[0] for one in (KEY, OTHER_KEY, "none")}) == 3
        live = gateway.sessions.in_use(session.session_id)
        admission = gateway.admission
        with admission.frame(live.key, session.session_id, time.perf_counter() + 1.0, 1.0):
            assert [parties.of_session(*one) for one in admission.wanted_by()] == [party_of(session.ego_token)[:2]]
