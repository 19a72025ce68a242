"""Errors as RFC 9457 problem details.

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

from robosac.defenses import shipped
from robosac.wire import WireError
from service.keeping.store import StoreUnavailable

logger = structlog.stdlib.get_logger(__name__)

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:robosac:problem:"


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Problem responses of a route, for its OpenAPI description."""
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
    return {
        status: {"description": HTTPStatus(status).phrase, "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in statuses
    }


class Problem(Exception):
    """A request that is refused.

    Parameters
    ----------
    status : int
    slug : str
        The last part of the problem's ``type``.
    detail : str
        What was wrong, for a human.
    field : str, optional
        Path of the offending part of the request.
    headers : mapping, optional
    """

    def __init__(
        self,
        status: int,
        slug: str,
        detail: str,
        field: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.slug = slug
        self.detail = detail
        self.field = field
        self.headers = headers

    @classmethod
    def from_wire(cls, error: WireError) -> Problem:
        """400 for a body that is no msgpack, 422 for one that says the wrong thing."""
        status = 400 if error.code == "malformed-msgpack" else 422
        return cls(status, error.code, error.detail, error.field or None)

    def response(self) -> JSONResponse:
        """The problem as a response."""
        body: dict[str, Any] = {
            "type": TYPE_PREFIX + self.slug,
            "title": self.slug.replace("-", " ").capitalize(),
            "status": self.status,
            "detail": self.detail,
        }
        if self.field is not None:
            body["field"] = self.field
        return JSONResponse(body, self.status, dict(self.headers or {}), media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Answer every error of an app as a problem."""

    @app.exception_handler(Problem)
    async def _problem(_: Request, error: Problem) -> JSONResponse:
        return error.response()

    @app.exception_handler(StoreUnavailable)
    async def _unavailable(_: Request, __: StoreUnavailable) -> JSONResponse:
        detail = "the database failed; nothing is acknowledged, try again"
        return Problem(503, "store-unavailable", detail, headers={"Retry-After": "1"}).response()

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        if first["type"] == "json_invalid":
            return Problem(
                400, "malformed-json", f"not JSON: {first.get('ctx', {}).get('error', first['msg'])}"
            ).response()
        where = [str(part) for part in first["loc"] if part not in ("body", "query", "path", *shipped())]
        return Problem(422, "invalid-request", str(first["msg"]), ".".join(where) or "body").response()

    @app.exception_handler(HTTPException)
    async def _http(_: Request, error: HTTPException) -> JSONResponse:
        slug = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")  # of 404 and 405, where no route fits
        return Problem(error.status_code, slug, str(error.detail), headers=error.headers).response()

    @app.exception_handler(Exception)
    async def _internal(request: Request, error: Exception) -> JSONResponse:
        logger.error("unhandled error", method=request.method, path=request.url.path, exc_info=error)
        return Problem(500, "internal-error", "the gateway failed to handle this request").response()
