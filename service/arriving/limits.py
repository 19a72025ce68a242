"""Bounds on requests: on the head, before anything looks at it, and on the body, in bytes and in time."""

from __future__ import annotations

import asyncio
import math

from fastapi import Request
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Problem

TARGET_BYTES = 2048
HEADERS = 128
HEADER_BYTES = 32 * 1024
UNREAD_BYTES = 2**21
"""If more of a body is left when its request is answered, the connection is closed: to take the rest costs time."""


def too_large(limit: int) -> Problem:
    """The refusal of a body of more than ``limit`` bytes."""
    return Problem(413, "too-large", f"a body may have at most {limit} bytes here")


def announced_bytes(headers: Headers) -> int:
    """The length that a request announces; 0 if it announces none."""
    announced = headers.get("content-length", "")
    return int(announced) if announced.isdecimal() and len(announced) < 20 else 0


async def read_bounded(request: Request, limit: int) -> bytes:
    """The body, never more than ``limit`` bytes of it; what is announced as more is not read at all.

    Raises
    ------
    Problem
        413 for a larger body, 400 if the client goes away before its end.
    """
    if announced_bytes(request.headers) > limit:
        raise too_large(limit)
    body = bytearray()
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > limit:
                raise too_large(limit)
    except ClientDisconnect as error:
        raise Problem(400, "incomplete-body", "the body ended before its announced length") from error
    return bytes(body)


class HeadLimit:
    """Refuses a request whose path, query or headers are absurdly long, since all that looks at them costs time."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        problem = _absurd_head(scope) if scope["type"] == "http" else None
        if problem is None:
            await self._app(scope, receive, send)
        else:
            await problem.response()(scope, receive, send)


def _absurd_head(scope: Scope) -> Problem | None:
    headers, close = scope["headers"], {"Connection": "close"}
    if len(scope["path"]) + len(scope["query_string"]) > TARGET_BYTES:
        return Problem(414, "uri-too-long", f"a path and its query may have {TARGET_BYTES} bytes", headers=close)
    if len(headers) > HEADERS or sum(len(name) + len(value) for name, value in headers) > HEADER_BYTES:
        detail = f"at most {HEADERS} headers of {HEADER_BYTES} bytes together are read"
        return Problem(431, "headers-too-large", detail, headers=close)
    return None


class BodyLimit:
    """Bounds every body, whatever route reads it: 413 by its announced length, else when it outgrows the limit; 408 if
    it is not there in time. Hangs up where much of a body was not wanted.

    Parameters
    ----------
    app : ASGI app
    limit : int
        Bytes.
    timeout_s : float
        From the first time that a route asks for it to its last byte.
    """

    def __init__(self, app: ASGIApp, limit: int, timeout_s: float) -> None:
        self._app = app
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
        complete = False
        end: float | None = None

        async def bounded() -> Message:
            nonlocal taken, complete, end
            if complete:
                return await receive()
            end = asyncio.get_running_loop().time() + self._timeout_s if end is None else end
            try:
                async with asyncio.timeout_at(end):
                    message = await receive()
            except TimeoutError as error:
                # connection: close, as the rest of the body may still come, or never
                raise Problem(
                    408, "slow-body", "the body did not come in time", headers={"Connection": "close"}
                ) from error
            complete = not message.get("more_body", False)
            taken += len(message.get("body", b""))
            if taken > self._limit:
                raise too_large(self._limit)
            return message

        async def hanging_up(message: Message) -> None:
            if message["type"] == "http.response.start" and not complete:
                left = math.inf if unannounced else announced - taken
                if left > UNREAD_BYTES and "connection" not in Headers(raw=message["headers"]):
                    message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
            await send(message)

        if announced > self._limit:
            await too_large(self._limit).response()(scope, receive, hanging_up)
        else:
            await self._app(scope, bounded, hanging_up)
