"""A bound on request bodies, kept while they are read."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class BodyLimit:
    """Refuses a body of more than ``limit`` bytes with 413: by its announced length before any of it is read, else
    when it outgrows the limit.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        announced = Headers(scope=scope).get("content-length", "")
        too_large = announced.isdecimal() and int(announced[:32]) > self._limit
        taken = 0

        async def bounded() -> Message:
            nonlocal taken
            if too_large:
                raise HTTPException(413, f"a body may have at most {self._limit} bytes")
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > self._limit:
                raise HTTPException(413, f"a body may have at most {self._limit} bytes")
            return message

        await self._app(scope, bounded, send)
