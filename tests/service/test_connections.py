"""A real server with a tiny application: what a client may take its time with, and what not."""

import asyncio
import contextlib
import socket
import time

import pytest
import uvicorn

from clients.hostile import Attack, Target, run_attack
from service.arriving.arrival import Arrival, arrival_of
from service.arriving.connections import AROUND_BYTES, HEAD_BYTES, HEADERS, PIECES, PIPELINED, BoundedHTTP
from service.watching.stalls import LoopWatch

GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
SLOW = b"GET /slow HTTP/1.1\r\nHost: x\r\n\r\n"
TIMEOUT_S = 0.4


LARGE = 2**24


class Hasty(BoundedHTTP):
    head_timeout_s = unread_timeout_s = TIMEOUT_S


async def application(scope, receive, send):
    if scope["type"] != "http":
        return
    waited_s = time.perf_counter() - arrival_of(scope)
    if scope["method"] == "POST":
        while (await receive()).get("more_body"):
            pass
    if scope["path"] == "/slow":
        await asyncio.sleep(2 * TIMEOUT_S)
    told = {"/large": bytes(LARGE), "/waited": b"%5.3f" % waited_s, "/head": repr(scope["headers"]).encode()}
    body = told.get(scope["path"], b"ok")
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture
async def port():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        config = uvicorn.Config(Arrival(application, LoopWatch()), http=Hasty, log_config=None, timeout_keep_alive=60)
        server = uvicorn.Server(config)
        serving = asyncio.create_task(server.serve([listening]))
        while not server.started:
            await asyncio.sleep(0.005)
        yield listening.getsockname()[1]
        server.should_exit = True
        await serving


@contextlib.asynccontextmanager
async def connected(port):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    yield reader, writer
    writer.close()


async def drip(writer, piece):
    with contextlib.suppress(ConnectionError):
        while piece and not writer.is_closing():
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(TIMEOUT_S / 8)


@pytest.mark.parametrize(
    ("first", "piece", "said"),
    [
        (b"", b"", b""),
        (b"\r\n", b"\r\n", b""),
        (b"G", b"", b"HTTP/1.1 408"),
        (b"GET / HTTP/1.1\r\nHost: x\r\n", b"", b"HTTP/1.1 408"),
        (b"GET / HTTP/1.1\r\n", b"a: b\r\n", b"HTTP/1.1 408"),
        (b"GET / HTTP/1.1\r\nlong: ", b"x", b"HTTP/1.1 408"),
        (GET, b"\r\n", b"HTTP/1.1 200"),
        (GET + b"GET / HTTP/1.1\r\nnext: ", b"x", b"HTTP/1.1 200"),
        (GET.replace(b"\r\n\r\n", b"\r\nContent-Length: 1000000\r\n\r\n"), b"x", b"HTTP/1.1 200"),
    ],
)
async def test_whoever_takes_too_long_before_there_is_a_request_is_hung_up_on(port, first, piece, said):
    async with connected(port) as (reader, writer):
        began = time.monotonic()
        dripping = asyncio.create_task(drip(writer, piece))
        writer.write(first)
        answer = b""
        with contextlib.suppress(ConnectionError):
            answer = await asyncio.wait_for(reader.read(-1), 30 * TIMEOUT_S)
        assert time.monotonic() - began > TIMEOUT_S * 0.9
        assert answer.startswith(said)
        assert answer or not said
        dripping.cancel()


async def test_a_request_may_be_answered_slowly_and_others_follow(port):
    async with connected(port) as (reader, writer):
        for request in (GET, SLOW, GET, SLOW + GET, b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n\r\n"):
            writer.write(request)
            for _ in range(request.count(b"HTTP/1.1")):
                assert b"200" in await reader.readuntil(b"\r\n\r\n")
                assert await reader.readexactly(2) == b"ok"
            await asyncio.sleep(TIMEOUT_S * 1.25)


async def test_a_body_may_take_longer_than_a_head(port):
    async with connected(port) as (reader, writer):
        writer.write(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 10\r\n\r\n")
        for _ in range(10):
            await asyncio.sleep(TIMEOUT_S / 5)
            writer.write(b"x")
        assert b"200" in await reader.readuntil(b"\r\n\r\n")


async def test_whoever_does_not_read_an_answer_is_cut_off(port):
    request = GET.replace(b"/", b"/large", 1).replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
    for slowly in (False, True):
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**16)
        writer.write(request)
        taken = 0
        try:
            await asyncio.sleep(0 if slowly else 3 * TIMEOUT_S)
            while piece := await reader.read(2**20):
                taken += len(piece)
                await asyncio.sleep(TIMEOUT_S / 40 if slowly else 0)
        except ConnectionError:
            pass
        assert (taken > LARGE) is slowly
        writer.close()


@pytest.mark.parametrize("before", [b"", GET])
async def test_a_head_without_end_is_cut_off(port, before):
    async with connected(port) as (reader, writer):
        writer.write(before + b"GET / HTTP/1.1\r\nlong: ")
        sent = 0
        with contextlib.suppress(ConnectionError):
            while sent < 64 * 2**20 and not reader.at_eof():
                writer.write(b"x" * 65536)
                await writer.drain()
                sent += 65536
                await asyncio.sleep(0)
        assert sent < 16 * 2**20
        answer = b""
        with contextlib.suppress(ConnectionError):
            answer = await reader.read(-1)
        assert not answer or b"431" in answer or before


CHUNKED = b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (GET[:-2] + b"a:\r\n" * HEADERS + b"\r\n", b"HTTP/1.1 431"),
        (CHUNKED + b"1\r\nx\r\n" * (PIECES + 1), b"HTTP/1.1 400"),
        (CHUNKED + b"0\r\n" + b"a: b\r\n" * (PIECES + 1), b"HTTP/1.1 400"),
        (GET * (PIPELINED + 2), b""),
    ],
)
async def test_what_takes_long_to_look_at_is_not_looked_at_to_its_end(port, sent, said):
    async with connected(port) as (reader, writer):
        writer.write(sent + b"the rest is not looked at")
        with contextlib.suppress(ConnectionError):
            answer = await asyncio.wait_for(reader.read(-1), 5.0)
            assert answer.startswith(said)
            assert bool(answer) == bool(said)
        await asyncio.sleep(0)
    async with connected(port) as (reader, writer):
        writer.write(GET)
        assert b"200" in await reader.readuntil(b"\r\n\r\n")


@pytest.mark.parametrize("sent", [CHUNKED + b"80\r\n%b\r\n" % bytes(128) * 16_000, CHUNKED + b"1\r\nx\r\n" * PIECES])
async def test_a_body_may_come_in_pieces(port, sent):
    async with connected(port) as (reader, writer):
        writer.write(sent + b"0\r\n\r\n")
        assert b"200" in await reader.readuntil(b"\r\n\r\n")


async def test_nothing_long_may_come_between_the_pieces_of_a_body(port):
    """As extensions of a piece's length do (RFC 9112, 7.1.1), which the parser passes over."""
    async with connected(port) as (reader, writer):
        for sent in (CHUNKED, *[b"1;" + b"a" * (AROUND_BYTES // 8) + b"\r\nx\r\n"] * 8):
            writer.write(sent)
            await asyncio.sleep(0.02)
        async with asyncio.timeout(10):
            assert (await reader.read()).startswith(b"HTTP/1.1 400 ")


async def test_a_body_may_come_with_the_end_of_the_one_before_it(port):
    post = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"
    async with connected(port) as (reader, writer):
        first, second = post % (3 * AROUND_BYTES) + bytes(3 * AROUND_BYTES), post % 10 + bytes(10)
        for sent in (first[:-5], first[-5:] + second[:-5], second[-5:]):
            writer.write(sent)
            await asyncio.sleep(0.05)
        async with asyncio.timeout(10):
            for _ in range(2):
                assert b"200" in await reader.readuntil(b"\r\n\r\n")


async def test_what_follows_a_body_is_not_of_the_head(port):
    """By which a request is let in, here and by whatever stands before the gateway (RFC 9110, 6.5.1)."""
    trailer = b"0\r\nAuthorization: Bearer key\r\nHost: y\r\nOrigin: z\r\n\r\n"
    async with connected(port) as (reader, writer):
        for begun in (b"", b"1\r\nx\r\n"):
            writer.write(CHUNKED.replace(b"/", b"/head", 1) + begun + trailer)
            head = await reader.readuntil(b"\r\n\r\n")
            told = await reader.readexactly(int(head.rpartition(b": ")[2]))
            assert told == repr([(b"host", b"x"), (b"transfer-encoding", b"chunked")]).encode()
        writer.write(GET[:-2].replace(b"/", b"/head", 1) + b"Origin: z\r\n\r\n")
        await reader.readuntil(b"\r\n\r\n")
        assert b"origin" in await reader.readuntil(b"]")


async def test_requests_may_be_pipelined(port):
    async with connected(port) as (reader, writer):
        writer.write(SLOW + GET * PIPELINED)
        for _ in range(PIPELINED + 1):
            assert b"200" in await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(2)


async def test_the_bodies_before_it_do_not_count_for_a_head(port):
    body = b"x" * (2 * HEAD_BYTES)
    post = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body)
    async with connected(port) as (reader, writer):
        for _ in range(3):
            writer.write(post + body + GET[:9])
            assert b"200" in await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(2)
            writer.write(GET[9:])
            assert b"200" in await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(2)


async def test_the_adversary_is_hung_up_on(port):
    target = Target(f"http://127.0.0.1:{port}", "", "", 0, b"", b"")
    answers = await asyncio.to_thread(run_attack, Attack.HEADS, target, 3 * TIMEOUT_S)
    slow = [answers[how] for how in ("408", "hung up", "ConnectionResetError")]  # its next byte may cut the answer off
    assert sum(slow) > 0
    assert answers["431"] > 0


async def test_a_head_of_any_size_that_is_looked_at_is_whole(port):
    async with connected(port) as (reader, writer):
        writer.write(GET.replace(b"Host: x", b"Host: x\r\nlong: " + b"x" * (HEAD_BYTES - 100)))
        assert b"200" in await reader.readuntil(b"\r\n\r\n")


@pytest.mark.parametrize("protocol", [b"websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: eA==", b"h2c"])
async def test_nobody_gets_another_protocol_by_which_nothing_is_bounded(port, protocol, caplog):
    async with connected(port) as (reader, writer):
        writer.write(GET.replace(b"Host: x", b"Host: x\r\nConnection: Upgrade\r\nUpgrade: " + protocol))
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 200")
        assert await reader.readexactly(2) == b"ok"
    assert "upgrade" not in caplog.text.lower()


WAITED = GET.replace(b"/", b"/waited", 1)
LARGER = b"POST /slow HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n" + bytes(1_000_000)


async def waited(reader):
    """How long the next request but those that are no concern here waited for the application, seconds."""
    while (await reader.readuntil(b"\r\n\r\n")).endswith(b"content-length: 2\r\n\r\n"):
        await reader.readexactly(2)
    return float(await reader.readexactly(5))


async def test_a_request_has_come_when_its_first_byte_has(port):
    async with connected(port) as (reader, writer):
        for at in (1, 4, 30):
            await asyncio.sleep(TIMEOUT_S / 3)  # the time between requests is nobody's
            writer.write(WAITED[:at])
            await asyncio.sleep(TIMEOUT_S / 3)
            writer.write(WAITED[at:])
            assert await waited(reader) == pytest.approx(TIMEOUT_S / 3, abs=TIMEOUT_S / 4)
        writer.write(WAITED)
        assert await waited(reader) < TIMEOUT_S / 4
        await asyncio.sleep(TIMEOUT_S / 3)
        writer.write(b"\r\n" + WAITED)
        assert await waited(reader) < TIMEOUT_S / 4


@pytest.mark.parametrize("before", [SLOW, LARGER])
@pytest.mark.parametrize("at", [0, 9])
async def test_a_pipelined_request_has_come_while_the_one_before_it_was_in_hand(port, before, at):
    async with connected(port) as (reader, writer):
        writer.write(before + WAITED[:at])
        await asyncio.sleep(TIMEOUT_S / 2)
        writer.write(WAITED[at:] + WAITED)
        for slow in (2.0 if at else 1.5, 1.5):
            assert await waited(reader) == pytest.approx(slow * TIMEOUT_S, abs=TIMEOUT_S / 4)
        writer.write(WAITED)
        assert await waited(reader) < TIMEOUT_S / 4
