"""What keeps a gateway from starting, told in one line that names the setting."""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from robosac.extras import MissingExtra
from robosac.faults import describe
from service.errors import StoreUnavailable
from service.settings import PREFIX

T = TypeVar("T")


@contextmanager
def asked_by(variable: str) -> Iterator[None]:
    """Say which variable asks for what an extra brings.

    Raises
    ------
    ValueError
        If the extra is not installed.
    """
    try:
        yield
    except MissingExtra as missing:
        raise ValueError(f"{variable}: {missing}") from missing


async def blamed_on(variable: str, starting: Awaitable[T], file: str | None = None) -> T:
    """Wait for a part of the gateway to start, or for what it needs to, such as the database in a file.

    Raises
    ------
    ValueError
        If it cannot, with the variable that is to blame: this one, or another that the fault names itself.
    """
    try:
        return await starting
    except ValueError as fault:
        if str(fault).startswith(PREFIX):
            raise
        raise ValueError(f"{variable}: {fault}") from fault
    except StoreUnavailable as fault:
        cause = fault.__cause__ or fault
        where = variable if file is None else f"{variable}: {file}"
        raise ValueError(f"{where}: {describe(getattr(cause, 'orig', None) or cause)}") from fault


class Starting:
    """Middleware that lets a server tell a wrong setting in one line, where the framework hands it a traceback.

    Any other fault keeps its traceback, as it is not the operator's.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def tell(message: Message) -> None:
            fault = sys.exception()  # the framework is handling it while it sends this
            if message["type"] == "lifespan.startup.failed" and isinstance(fault, ValueError):
                message = {**message, "message": str(fault)}
            await send(message)

        await self._app(scope, receive, tell if scope["type"] == "lifespan" else send)
