"""What no client's library would send, or would not read."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from clients.client import MSGPACK
from clients.hostile.attacker import PAUSE_S, Attacker
from clients.raw_http import connected, post_head, read_response

CONNECTIONS = 24
HEADS = 240
VIEWERS = 64
PIPELINED = 2000
CHUNKED_BYTES = 200_000
SHORT_HEADERS = 8000

Reader: TypeAlias = asyncio.StreamReader
Writer: TypeAlias = asyncio.StreamWriter


async def flood(attacker: Attacker) -> None:
    """Send large bodies that are no messages, each connection again and again; every third sends slowly."""
    session = await attacker.open(attacker.frame["teammates"])
    url, size = attacker.target.url, len(attacker.target.frame)
    path = f"/v1/sessions/{session['session_id']}/frames"
    head = post_head(url, path, size, session["ego_token"], Connection="close")

    async def one(slowly: bool) -> None:
        async with connected(url) as (reader, writer):
            writer.write(head)
            if slowly:
                writer.write(bytes(size // 2))
                await asyncio.sleep(1.0)
                writer.write(bytes(size - size // 2))
            else:
                writer.write(bytes(size))
            status, _ = await read_response(reader)
            attacker.answers[str(status)] += 1
        await asyncio.sleep(PAUSE_S)

    slow = CONNECTIONS // 3
    await asyncio.gather(
        attacker.again_and_again(slow, lambda: one(True)),
        attacker.again_and_again(CONNECTIONS - slow, lambda: one(False)),
    )


async def heads(attacker: Attacker) -> None:
    """Send heads that never end; one in twelve fast."""

    async def one(slowly: bool) -> None:
        async with connected(attacker.target.url) as (reader, writer):
            writer.write(b"GET /healthz HTTP/1.1\r\nlong: ")
            line = await _while_dripping(reader, writer, slowly=slowly)
            attacker.answers[line.split(b" ")[1].decode() if line else "hung up"] += 1
        await asyncio.sleep(PAUSE_S)

    fast = HEADS // 12
    await asyncio.gather(
        attacker.again_and_again(HEADS - fast, lambda: one(True)), attacker.again_and_again(fast, lambda: one(False))
    )


async def headers(attacker: Attacker) -> None:
    """Send heads of many short lines."""
    head = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + b"a:\r\n" * SHORT_HEADERS + b"\r\n"
    await _exchange(attacker, head)


async def chunks(attacker: Attacker) -> None:
    """Send a body in chunks of a byte, to where a message may be as large."""
    session_id, _, token = await attacker.as_teammate()
    fields = (
        f"POST /v1/sessions/{session_id}/messages HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}\r\n"
        f"Content-Type: {MSGPACK}\r\nTransfer-Encoding: chunked\r\n\r\n"
    )
    request = fields.encode() + b"1\r\n\xc1\r\n" * CHUNKED_BYTES + b"0\r\n\r\n"
    await _exchange(attacker, request)


async def dripping(attacker: Attacker) -> None:
    """Send bodies as many small writes, to where a message may be as large."""
    session_id, _, token = await attacker.as_teammate()
    url, path = attacker.target.url, f"/v1/sessions/{session_id}/messages"
    head = post_head(url, path, CHUNKED_BYTES, token, Connection="close")

    async def one() -> None:
        async with connected(url) as (reader, writer):
            writer.write(head)
            answer = asyncio.ensure_future(read_response(reader))
            try:
                while not answer.done():
                    writer.write(b"\xc1")
                    await asyncio.sleep(0)
                status, _ = await answer
            finally:
                answer.cancel()
                await asyncio.gather(answer, return_exceptions=True)
            attacker.answers[str(status)] += 1

    await attacker.again_and_again(CONNECTIONS, one)


async def streams(attacker: Attacker) -> None:
    """Stand by on one stream after the other: each ends the one before."""
    session_id, _, token = await attacker.as_teammate()
    head = f"GET /v1/sessions/{session_id}/standby HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}\r\n\r\n"

    async def one() -> None:
        async with connected(attacker.target.url) as (reader, writer):
            writer.write(head.encode())
            line = await reader.readline()
            attacker.answers[line.split(b" ")[1].decode() if line else "hung up"] += 1

    await attacker.again_and_again(CONNECTIONS, one)


async def knocks(attacker: Attacker) -> None:
    """Make connections, and end them without a word."""

    async def one() -> None:
        async with connected(attacker.target.url):
            attacker.answers["made"] += 1

    await attacker.again_and_again(CONNECTIONS, one)


async def upgrades(attacker: Attacker) -> None:
    """Ask for a WebSocket on each connection."""
    request = (
        b"GET /v1/live HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: eA==\r\n\r\n"
    )
    await _exchange(attacker, request)


async def pipeline(attacker: Attacker) -> None:
    """Send thousands of requests before the first answer, and read what comes."""
    request = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n" * PIPELINED

    async def one() -> None:
        async with connected(attacker.target.url) as (reader, writer):
            writer.write(request)
            for _ in range(PIPELINED):
                status, _ = await read_response(reader)
                attacker.answers[str(status)] += 1

    await attacker.again_and_again(CONNECTIONS, one)


async def unread(attacker: Attacker) -> None:
    """Ask for long answers, many at a time, and read none."""
    request = b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * PIPELINED

    async def held(_: Reader, writer: Writer) -> None:
        writer.write(request)
        await asyncio.sleep(PAUSE_S)

    await _hold(attacker, 8 * CONNECTIONS, held)


async def viewers(attacker: Attacker) -> None:
    """Watch the honest session, and read nothing."""
    path, token = f"/v1/live/{attacker.target.session_id}", attacker.target.viewer_token
    request = f"GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}\r\n\r\n".encode()

    async def held(reader: Reader, writer: Writer) -> None:
        writer.write(request)
        line = await reader.readline()
        attacker.answers[line.split(b" ")[1].decode() if line else "hung up"] += 1

    await _hold(attacker, VIEWERS, held)


async def _hold(attacker: Attacker, number: int, held: Callable[[Reader, Writer], Awaitable[None]]) -> None:
    """Do something on connections, and keep them without reading more."""

    async def one() -> None:
        async with connected(attacker.target.url) as (reader, writer):
            await held(reader, writer)
            attacker.answers["held"] += 1
            await asyncio.sleep(3600.0)

    await attacker.again_and_again(number, one)


async def _exchange(attacker: Attacker, request: bytes) -> None:
    """Send a request on connections of their own, again and again, and count the answers."""

    async def one() -> None:
        async with connected(attacker.target.url) as (reader, writer):
            writer.write(request)
            status, _ = await read_response(reader)
            attacker.answers[str(status)] += 1

    await attacker.again_and_again(CONNECTIONS, one)


async def _while_dripping(reader: Reader, writer: Writer, *, slowly: bool) -> bytes:
    """The first line of what a server answers while it is sent more and more; empty if it hangs up."""
    answer = asyncio.ensure_future(reader.readline())
    try:
        while not answer.done():
            writer.write(b"x" if slowly else b"x" * 2**16)
            await writer.drain()
            await asyncio.wait([answer], timeout=PAUSE_S)
        return await answer
    finally:
        answer.cancel()
        await asyncio.gather(answer, return_exceptions=True)
