"""Requests that are turned away by their heads alone, before a route looks at them."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Callable

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service import problems
from service.deciding.admission import Admission
from service.errors import Kind, Refused
from service.sessions.live import LiveSession

TARGET_BYTES = 2048
HEADERS = 128
HEADER_BYTES = 32 * 1024
OPEN_PATHS = ("/healthz",)
_FRAMES_PATH = re.compile(r"/v1/sessions/([^/]+)/frames")


class Door:
    """Middleware that turns away the requests whose heads a check refuses.

    Parameters
    ----------
    app : ASGI app
    check : callable
        Raises `Refused` for a request that is not let in.
    """

    def __init__(self, app: ASGIApp, check: Callable[[Scope], None]) -> None:
        self._app = app
        self._check = check

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        answer = self._app
        if scope["type"] == "http":
            try:
                self._check(scope)
            except Refused as refused:
                answer = problems.response(refused)
        await answer(scope, receive, send)


def check_head(scope: Scope) -> None:
    """Refuse an absurdly long path, query or headers, since all that looks at them costs time."""
    headers = scope["headers"]
    if len(scope["path"]) + len(scope["query_string"]) > TARGET_BYTES:
        raise Refused(Kind.URI_TOO_LONG, f"a path and its query may have {TARGET_BYTES} bytes")
    if len(headers) > HEADERS or sum(len(name) + len(value) for name, value in headers) > HEADER_BYTES:
        detail = f"at most {HEADERS} headers of {HEADER_BYTES} bytes together are read"
        raise Refused(Kind.HEADERS_TOO_LARGE, detail)


def check_local(scope: Scope) -> None:
    """Refuse other machines, but for `OPEN_PATHS`: for a gateway whose sessions anybody can open."""
    if scope["path"] not in OPEN_PATHS and not is_local(scope):
        detail = "without an API key the gateway serves its own machine only; set ROBOSAC_API_KEYS"
        raise Refused(Kind.LOOPBACK_ONLY, detail)


def is_local(scope: Scope) -> bool:
    """Whether a request comes from this machine: over loopback or a unix socket, and no proxy has forwarded it."""
    headers = Headers(scope=scope)
    if "x-forwarded-for" in headers or "forwarded" in headers:
        return False
    client, server = scope.get("client"), scope.get("server")
    if client is None:  # a unix socket has a path and no port; a peer on the network may be gone already
        return server is not None and server[1] is None
    try:
        address = ipaddress.ip_address(client[0])
    except ValueError:
        return False
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


def capacity_check(admission: Admission, in_use: Callable[[str], LiveSession | None]) -> Callable[[Scope], None]:
    """A check that refuses whole frames beyond capacity, before anything is authenticated or looked up.

    ``in_use`` gives what is held of a session that is in use, by its id; None if it is not.
    """

    def check(scope: Scope) -> None:
        found = _FRAMES_PATH.fullmatch(scope["path"]) if scope["method"] == "POST" else None
        live = in_use(found[1]) if found else None
        if found and live is not None:
            admission.check(live.key, found[1], live.budget_s)

    return check
