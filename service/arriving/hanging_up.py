"""Hangs up on whoever has stopped to read a stream."""

from __future__ import annotations

import asyncio
import re

import structlog
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.arriving.paths import path_of

logger = structlog.stdlib.get_logger(__name__)

PATIENCE_S = 30.0
"""How long a socket may take nothing. Meanwhile `service.viewing.viewers` bounds what waits for a viewer's, and
`service.sessions.pages` what of a log or of kept messages.
"""
_STREAMED = re.compile(r"/v1/(live/|sessions/[^/]*/(audit|standby|frames/[^/]*/messages)$)")


class HangingUp:
    """Middleware that ends a stream whose socket takes nothing for too long: of a viewer, a log, or kept messages."""

    def __init__(self, app: ASGIApp, patience_s: float = PATIENCE_S) -> None:
        self._app = app
        self._patience_s = patience_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not _STREAMED.match(path_of(scope)):
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
                raise OSError("whoever asked does not read") from None

        try:
            await self._app(scope, receive, patient)
        except (OSError, ClientDisconnect):  # which of them depends on the server's version of ASGI
            if not hung_up:
                raise
            logger.info("hung up on somebody who does not read", path=scope["path"])
