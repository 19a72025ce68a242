"""Whose the event loop's time was: whoever's request, or connection, it had just done something for.

Nothing that takes long to import may be imported here: a server needs this before the application.
"""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable, Generator
from dataclasses import dataclass
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send

from service.arriving.pacing import KEY, Pacing, Party

METER = "robosac_meter"
"""In a request's state: its `Meter`."""


@dataclass(frozen=True)
class Meter:
    """Puts what a request costs down to its sender."""

    pacing: Pacing
    party: Party

    def step(self) -> None:
        """The loop has just done something for it."""
        self.pacing.had_since(self.party)

    def elsewhere(self, seconds: float) -> None:
        """Another thread had so much for it, and kept the loop's waiting."""
        self.pacing.charge(self.party, seconds)


class Metered:
    """Middleware that has the loop's time measured that a request's answer takes, where its server wants to know.

    Parameters
    ----------
    app : ASGI app
    pacing : Pacing
        What such a server is lent.
    """

    def __init__(self, app: ASGIApp, pacing: Pacing) -> None:
        self._app = app
        self._pacing = pacing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" and "state" in scope:
            scope["state"][KEY] = self._pacing
        meter = scope["state"].get(METER) if scope["type"] == "http" and "state" in scope else None
        answer = self._app(scope, receive, send)
        await (answer if meter is None else _Steps(answer, meter.step))


class _Steps:
    """Awaits something, and tells of each of its steps."""

    def __init__(self, awaited: Awaitable[None], stepped: Callable[[], None]) -> None:
        self._awaited = awaited
        self._stepped = stepped

    def __await__(self) -> Generator[Any, Any, None]:
        steps = self._awaited.__await__()
        step: Callable[[], Any] = steps.__next__
        while True:
            try:
                waits_for = step()
            except StopIteration:
                return
            finally:
                self._stepped()
            try:
                yield waits_for
            except GeneratorExit:
                steps.close()
                raise
            except BaseException as error:
                step = functools.partial(steps.throw, error)
            else:
                step = steps.__next__
