"""When a request came: the moment from which a frame's budget runs."""

from __future__ import annotations

import time

from starlette.types import ASGIApp, Receive, Scope, Send

from service.watching.stalls import LoopWatch

_KEY = "robosac.arrived"


class Arrival:
    """The outermost middleware: notes when a request came, before anything is asked of it.

    A server calls it once it has read the head of a request, and before the body. What lies before that call it cannot
    see, but for the time in which the event loop stood still (`LoopWatch`): how long the head itself took to come, and
    what the kernel and a proxy kept.

    Parameters
    ----------
    app : ASGI app
    watch : LoopWatch
    """

    def __init__(self, app: ASGIApp, watch: LoopWatch) -> None:
        self._app = app
        self._watch = watch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            scope[_KEY] = self._watch.arrived()
        await self._app(scope, receive, send)


def arrival_of(scope: Scope) -> float:
    """When a request came (`time.perf_counter`)."""
    return float(scope.get(_KEY, time.perf_counter()))
