"""Bounds on the bodies of requests, in bytes and in time."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable

from fastapi import Request
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import problems
from service.errors import Draining, Kind, Refused

UNREAD_BYTES = 2**21
"""If more of a body is left when its request is answered, the connection is closed: to take the rest costs time."""
_DIGITS = 20
"""Of an announced length that are read: any bound is passed by then, and Python makes no number of thousands."""


def too_large(limit: int) -> Refused:
    """The refusal of a body of more than ``limit`` bytes."""
    return Refused(Kind.TOO_LARGE, f"a body may have at most {limit} bytes here")


def announced_bytes(headers: Headers) -> int:
    """The length that a request announces; 0 if it announces none."""
    announced = headers.get("content-length", "")
    return int(announced.lstrip("0")[:_DIGITS] or 0) if announced.isdecimal() else 0


def expected_bytes(request: Request, limit: int) -> int:
    """The most that a request's body may take here: what it announces, or else as much as is read."""
    announced = announced_bytes(request.headers)
    return announced if 0 < announced <= limit else 0 if announced > limit else limit


async def read_bounded(request: Request, limit: int, came: Callable[[], None] = lambda: None) -> bytes:
    """The body, never more than ``limit`` bytes of it; what is announced as more is not read at all. ``came`` is called
    at each piece.

    Raises
    ------
    Refused
        If the body is larger (``too-large``), or the client goes away before its end (``incomplete-body``).
    """
    if announced_bytes(request.headers) > limit:
        raise too_large(limit)
    body = bytearray()
    try:
        async for chunk in request.stream():
            came()
            body += chunk
            if len(body) > limit:
                raise too_large(limit)
    except ClientDisconnect as error:
        raise Refused(Kind.INCOMPLETE_BODY, "the body ended before its announced length") from error
    return bytes(body)


async def hung_up(request: Request) -> None:
    """Wait until whoever sent a request, whose body is read, hangs up."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


class Unfinished:
    """The bodies that a process waits for."""

    def __init__(self) -> None:
        self.given_up = False
        self._waits: set[asyncio.Timeout] = set()

    @contextlib.asynccontextmanager
    async def wait_until(self, end: float | None) -> AsyncIterator[None]:
        """Wait in a block for more of one until then, by the loop's clock, or without end.

        Raises
        ------
        Refused
            If it has not come by then (``slow-body``), or bodies are given up (``draining``).
        """
        try:
            async with asyncio.timeout_at(-math.inf if self.given_up and end is not None else end) as wait:
                self._waits.add(wait)
                try:
                    yield
                finally:
                    self._waits.discard(wait)
        except TimeoutError as error:
            if self.given_up:
                raise Draining from error
            raise Refused(Kind.SLOW_BODY, "the body did not come in time") from error

    def give_up(self) -> None:
        """The process is to end: wait for no body any more that is not there."""
        self.given_up = True
        for wait in self._waits:
            if not wait.expired():
                wait.reschedule(-math.inf)


class BodyLimit:
    """Bounds every body, whatever route reads it: one that is too large is refused by its announced length, else when
    it outgrows the limit; one that is too slow, when its time is over. Hangs up where much of a body was not wanted.
    Nobody wants one that comes beside an answer that goes on: it may take its time, and ends the answer if it is too
    large.

    Parameters
    ----------
    app : ASGI app
    limit : int
        Bytes.
    timeout_s : float
        From the first time that a route asks for it to its last byte.
    unfinished : Unfinished
        Those of the process.
    """

    def __init__(self, app: ASGIApp, limit: int, timeout_s: float, unfinished: Unfinished) -> None:
        self._app = app
        self._unfinished = unfinished
        self._limit = limit
        self._timeout_s = timeout_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        announced = announced_bytes(headers)
        unannounced = announced == 0 and "transfer-encoding" in headers
        taken = 0
        complete = started = False
        end: float | None = None

        async def bounded() -> Message:
            nonlocal taken, complete, end
            if complete:
                return await receive()
            end = asyncio.get_running_loop().time() + self._timeout_s if end is None else end
            try:
                async with self._unfinished.wait_until(None if started else end):
                    message = await receive()
            except Refused:
                if not started:
                    raise
                message = await receive()
            complete = not message.get("more_body", False)
            taken += len(message.get("body", b""))
            if taken > self._limit:
                if started:
                    return {"type": "http.disconnect"}
                raise too_large(self._limit)
            return message

        async def hanging_up(message: Message) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            if message["type"] == "http.response.start" and not complete:
                left = math.inf if unannounced else announced - taken
                if left > UNREAD_BYTES and "connection" not in Headers(raw=message["headers"]):
                    message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
            await send(message)

        if announced > self._limit:
            await problems.response(too_large(self._limit))(scope, receive, hanging_up)
        else:
            await self._app(scope, bounded, hanging_up)
