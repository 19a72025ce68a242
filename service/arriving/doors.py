"""Requests that are turned away by their heads alone, before a route looks at them."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Callable, Collection
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service import problems
from service.arriving.arrival import arrival_of
from service.arriving.paths import path_of
from service.deciding.admission import Admission
from service.errors import Kind, Refused
from service.sessions.live import LiveSession

TARGET_BYTES = 2048
HEADERS = 128
HEADER_BYTES = 32 * 1024
OPEN_PATHS = ("/healthz",)
_AUTHORITY = re.compile(r"([^:\[\]@/]+|\[[^\[\]]*\])(?::\d*)?")
_BODIES_PATH = re.compile(r"/v1/sessions/([^/]+)/(frames|messages)")


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
    """Refuse an absurdly long path, query or headers, since all that looks at them costs time; and two names of the
    gateway, of which a proxy may have looked at the other one (RFC 9112, section 3.2).
    """
    headers = scope["headers"]
    if sum(name == b"host" for name, _ in headers) > 1:
        raise Refused(Kind.FOREIGN_HOST, "a request names its host once", "Host")
    if len(scope["path"]) + len(scope["query_string"]) > TARGET_BYTES:
        raise Refused(Kind.URI_TOO_LONG, f"a path and its query may have {TARGET_BYTES} bytes")
    if len(headers) > HEADERS or sum(len(name) + len(value) for name, value in headers) > HEADER_BYTES:
        detail = f"at most {HEADERS} headers of {HEADER_BYTES} bytes together are read"
        raise Refused(Kind.HEADERS_TOO_LARGE, detail)


def check_local(scope: Scope) -> None:
    """Refuse other machines, but for `OPEN_PATHS`: for a gateway whose sessions anybody can open."""
    if path_of(scope) not in OPEN_PATHS and not is_local(scope):
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
    return _is_loopback(client[0])


def host_check(names: Collection[str]) -> Callable[[Scope], None]:
    """A check that refuses requests for other hosts than these and loopback's, and from pages of others.

    A web page may resolve its own name to 127.0.0.1 (DNS rebinding), or post there without reading the answer. A
    browser then tells its name, as ``Host`` or as ``Origin``; which port it is does not matter.

    Parameters
    ----------
    names : collection of str
        In lower case, without ports, IPv6 addresses without brackets.
    """

    def is_known(authority: str) -> bool:
        found = _AUTHORITY.fullmatch(authority)
        host = found[1].lower().rstrip(".").strip("[]") if found else ""
        return host == "localhost" or host in names or _is_loopback(host)

    def check(scope: Scope) -> None:
        if path_of(scope) in OPEN_PATHS:
            return
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not is_known(hosts[0]):
            detail = "the gateway is not known by the name in 'Host'; ask for localhost, or set ROBOSAC_ALLOWED_HOSTS"
            raise Refused(Kind.FOREIGN_HOST, detail, "Host")
        for origin in headers.getlist("origin"):
            if not is_known(_authority_of(origin)):
                detail = "web pages of other hosts may not use this gateway; set ROBOSAC_ALLOWED_HOSTS to let them"
                raise Refused(Kind.FOREIGN_ORIGIN, detail, "Origin")

    return check


def _authority_of(origin: str) -> str:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _is_loopback(text: str) -> bool:
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return False
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


def capacity_check(admission: Admission, in_use: Callable[[str], LiveSession | None]) -> Callable[[Scope], None]:
    """A check that refuses whole frames beyond capacity, before anything is authenticated or looked up; and tells the
    admission that frames and messages begin to come.

    ``in_use`` gives what is held of a session that is in use, by its id; None if it is not.
    """

    def check(scope: Scope) -> None:
        found = _BODIES_PATH.fullmatch(path_of(scope)) if scope["method"] == "POST" else None
        live = in_use(found[1]) if found else None
        if not found or live is None:
            return
        admission.expect(live.key, found[1])
        if found[2] == "frames":
            admission.check(live.key, found[1], arrival_of(scope) + live.budget_s)

    return check
