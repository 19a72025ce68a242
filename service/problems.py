"""Errors as RFC 9457 problem details: the one place that knows how a refusal is answered over HTTP.

Every refusal is ``application/problem+json`` with a stable ``type``, and where a part of the request is to blame, its
path in ``field``.
"""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.routing import Match
from starlette.types import Receive, Scope, Send

from robosac.defenses import shipped
from robosac.faults import in_words
from robosac.possession import ALGORITHM
from robosac.wire import WireError
from service.errors import Kind, Refused

logger = structlog.stdlib.get_logger(__name__)

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:robosac:problem:"
_CHALLENGE = {"WWW-Authenticate": "Bearer"}
_PROOF = {"WWW-Authenticate": f'DPoP algs="{ALGORITHM}", error="invalid_dpop_proof"'}  # RFC 9449, section 7.1
_UNROUTED = {404: "there is nothing at this path", 405: "this path does not take this method"}
_CLOSE = {"Connection": "close"}  # as the rest of the body may still come, or never
ANSWERS: Mapping[Kind, tuple[int, Mapping[str, str]]] = {
    Kind.MALFORMED_JSON: (400, {}),
    Kind.INCOMPLETE_BODY: (400, {}),
    Kind.HUNG_UP: (400, {}),
    Kind.UNAUTHENTICATED: (401, _CHALLENGE),
    Kind.TOKEN_EXPIRED: (401, _CHALLENGE),
    Kind.BAD_SIGNATURE: (401, {}),
    Kind.BAD_PROOF: (401, _PROOF),
    Kind.NOT_ENROLLED: (403, {}),
    Kind.LOOPBACK_ONLY: (403, _CLOSE),
    Kind.FOREIGN_HOST: (421, _CLOSE),
    Kind.FOREIGN_ORIGIN: (403, _CLOSE),
    Kind.MISROUTED: (421, _CLOSE),
    Kind.EGO_ONLY: (403, {}),
    Kind.WRONG_VEHICLE: (403, {}),
    Kind.UNKNOWN_SESSION: (404, {}),
    Kind.UNKNOWN_TEAMMATE: (404, {}),
    Kind.MESSAGES_NOT_KEPT: (404, {}),
    Kind.SLOW_BODY: (408, _CLOSE),
    Kind.ALREADY_ENROLLED: (409, {}),
    Kind.STALE_FRAME: (409, {}),
    Kind.DUPLICATE_MESSAGE: (409, {}),
    Kind.EQUIVOCATION: (409, {}),
    Kind.SESSION_CHANGED: (409, {}),
    Kind.TOO_FAR_AHEAD: (409, {}),
    Kind.TOO_LARGE: (413, {}),
    Kind.URI_TOO_LONG: (414, _CLOSE),
    Kind.HEADERS_TOO_LARGE: (431, _CLOSE),
    Kind.UNSUPPORTED_MEDIA_TYPE: (415, {}),
    Kind.UNSUPPORTED_ENCODING: (415, {}),
    Kind.IMPLAUSIBLE_POSE: (422, {}),
    Kind.INVALID_REQUEST: (422, {}),
    Kind.IMPOSSIBLE_DEFENSE: (422, {}),
    Kind.UNKNOWN_DETECTOR: (422, {}),
    Kind.TOO_MANY_TEAMMATES: (422, {}),
    Kind.TOO_MANY_RENEWALS: (429, {"Retry-After": "60"}),
    Kind.TOO_MANY_CHANGES: (429, {"Retry-After": "1"}),
    Kind.TOO_MANY_PROOFS: (429, {"Retry-After": "60"}),
    Kind.INTERNAL_ERROR: (500, {}),
    Kind.NOT_READY: (503, {"Retry-After": "5"}),
    Kind.TOO_MANY_VIEWERS: (503, {"Retry-After": "10"}),
    Kind.TOO_MANY_SESSIONS: (503, {"Retry-After": "30"}),
    Kind.OVERLOADED: (503, {"Retry-After": "1"}),
    Kind.DRAINING: (503, {"Retry-After": "0"}),
    Kind.DETECTOR_UNAVAILABLE: (503, {}),
    Kind.DEFENSE_UNAVAILABLE: (503, {}),
    Kind.AUDIT_FULL: (507, {}),
    Kind.KEY_FULL: (507, {}),
    Kind.STORE_UNAVAILABLE: (503, {"Retry-After": "1"}),
    Kind.STORE_TOO_SLOW: (503, {"Retry-After": "1"}),
}
"""Status and headers of each refusal."""


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Problem responses of a route, for its OpenAPI description, each with an example."""
    schema = {
        "type": "object",
        "required": ["type", "title", "status", "detail"],
        "properties": {
            "type": {"type": "string", "examples": [TYPE_PREFIX + "wrong-shape"]},
            "title": {"type": "string"},
            "status": {"type": "integer"},
            "detail": {"type": "string"},
            "field": {"type": "string", "description": "The part of the request that is to blame, if one is."},
        },
    }
    told: dict[int | str, dict[str, Any]] = {}
    for status in statuses:
        kind = next(kind for kind, (answered, _) in ANSWERS.items() if answered == status)
        example = _fields(status, kind.value, "what was wrong, for a human")
        content = {MEDIA_TYPE: {"schema": schema, "example": example}}
        told[status] = {"description": HTTPStatus(status).phrase, "content": content}
    return told


def response(refused: Refused) -> JSONResponse:
    """A refusal as a response."""
    status, headers = ANSWERS[refused.kind]
    if refused.retry_after_s is not None:
        headers = {**headers, "Retry-After": str(refused.retry_after_s)}
    return _problem(status, refused.kind.value, refused.detail, refused.field, headers)


def install(app: FastAPI) -> None:
    """Answer every error of an app as a problem."""

    @app.exception_handler(Refused)
    async def _refused(_: Request, refused: Refused) -> JSONResponse:
        return response(refused)

    @app.exception_handler(WireError)
    async def _no_message(_: Request, error: WireError) -> JSONResponse:
        status = 400 if error.code == "malformed-msgpack" else 422  # no msgpack at all, or it says the wrong thing
        return _problem(status, error.code, error.detail, error.field or None)

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        if first["type"] == "json_invalid":
            detail = f"not JSON: {first.get('ctx', {}).get('error', first['msg'])}"
            return response(Refused(Kind.MALFORMED_JSON, detail))
        where = [str(part) for part in first["loc"] if part not in ("body", "query", "path", *shipped())]
        return response(Refused(Kind.INVALID_REQUEST, in_words(first), ".".join(where) or "body"))

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        slug = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")  # of 404 and 405, where no route fits
        headers = error.headers
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # Starlette tells those of the first route that fits
            headers = {"Allow": ", ".join(_methods(app, request.scope))}
        return _problem(error.status_code, slug, _UNROUTED.get(error.status_code, error.detail), headers=headers)

    @app.exception_handler(Exception)
    async def _internal(request: Request, error: Exception) -> JSONResponse:
        logger.error("unhandled error", method=request.method, path=request.url.path, exc_info=error)
        return response(Refused(Kind.INTERNAL_ERROR, "the gateway failed to handle this request"))


def _methods(app: FastAPI, scope: Scope) -> list[str]:
    """What may be asked for at a request's path."""

    def fits(method: str) -> bool:
        return any(route.matches({**scope, "method": method})[0] is Match.FULL for route in app.routes)

    return [method for method in ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT") if fits(method)]


class _Problem(JSONResponse):
    """Counted as it is sent, whether a route, a handler of errors or a middleware answers with it."""

    media_type = MEDIA_TYPE

    def __init__(self, fields: Mapping[str, Any], status: int, headers: Mapping[str, str], slug: str) -> None:
        super().__init__(fields, status, headers)
        self._slug = slug

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if (app := scope.get("app")) is not None:  # none where a door stands before another application
            app.state.gateway.metrics.problem(self._slug)
        await super().__call__(scope, receive, send)


def _problem(
    status: int, slug: str, detail: str, field: str | None = None, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    body = _fields(status, slug, detail) | ({} if field is None else {"field": field})
    return _Problem(body, status, headers or {}, slug)


def _fields(status: int, slug: str, detail: str) -> dict[str, Any]:
    title = slug.replace("-", " ").capitalize()
    return {"type": TYPE_PREFIX + slug, "title": title, "status": status, "detail": detail}
