"""When a request came: the moment from which a frame's budget runs."""

from __future__ import annotations

import time
from collections.abc import MutableMapping
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send

from service.watching.stalls import LoopWatch

_KEY = "robosac.arrived"
_CLOCK, _FIRST_BYTE = "robosac_clock", "robosac_first_byte"
"""In the state that the lifespan shares with requests."""


class Arrival:
    """The outermost middleware: notes when a request came, before anything is asked of it.

    A server that notes a request's first byte itself (`note_first_byte`) is believed, and is lent the clock to do so.
    Any other calls this once it has read the head of a request, and before the body. What lies before that call cannot
    be seen then, but for the time in which the event loop stood still (`LoopWatch`).

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
            scope[_KEY] = scope.get("state", {}).get(_FIRST_BYTE) or self._watch.arrived()
        elif scope["type"] == "lifespan" and "state" in scope:
            scope["state"][_CLOCK] = self._watch.arrived
        await self._app(scope, receive, send)


def note_first_byte(state: MutableMapping[str, Any], waited_s: float = 0.0) -> None:
    """Note that the first byte of a request is seen now, in its own copy of the lifespan's state, and for how long it
    has waited at least.
    """
    arrived = state.get(_CLOCK)
    if arrived is not None:
        state[_FIRST_BYTE] = min(arrived(), time.perf_counter() - waited_s) if waited_s else arrived()


def arrival_of(scope: Scope) -> float:
    """When a request came (`time.perf_counter`)."""
    return float(scope.get(_KEY, time.perf_counter()))
