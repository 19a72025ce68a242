"""Hangs up on viewers who have stopped to read."""

from __future__ import annotations

import asyncio

import structlog
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.arriving.paths import path_of

logger = structlog.stdlib.get_logger(__name__)

PATIENCE_S = 30.0
"""How long the socket of a viewer may take nothing. Meanwhile `service.viewing.viewers` bounds what waits for it."""
PATH = "/v1/live/"


class HangingUp:
    """Middleware that ends the stream of a viewer whose socket takes nothing for too long."""

    def __init__(self, app: ASGIApp, patience_s: float = PATIENCE_S) -> None:
        self._app = app
        self._patience_s = patience_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not path_of(scope).startswith(PATH):
            await self._app(scope, receive, send)
            return
        hung_up = False

        async def patient(message: Message) -> None:
            nonlocal hung_up
            try:
                async with asyncio.timeout(self._patience_s):
                    await send(message)
            except TimeoutError:
                hung_up = True
                raise OSError("the viewer does not read") from None

        try:
            await self._app(scope, receive, patient)
        except (OSError, ClientDisconnect):  # which of them depends on the server's version of ASGI
            if not hung_up:
                raise
            logger.info("hung up on a viewer who does not read", path=scope["path"])
