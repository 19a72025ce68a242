"""What a request's body is read into, once its sender is known: every route asks for the credential first.

FastAPI would read a body that it knows of before it asks for anything, and parse it on the event loop. So the routes
declare none, and read theirs here.
"""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any, TypeVar

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from robosac.wire.bodies import named_once
from service.arriving.limits import read_bounded
from service.arriving.metering import METER
from service.errors import Kind, Refused

JSON = "application/json"
JSON_BYTES = 256 * 1024
"""The largest JSON body: a team of 1024 with keys, or a defence's calibration, with room to spare."""
MOST_VALUES = 4096
"""In a JSON body: no request has more. To tell what is wrong with each of many would take long."""
MOST_MEMBERS = 1100
"""Of an object in it: for each that is not known there is an error."""
SMALL_BYTES = 4 * 1024
"""What is parsed on the event loop: for less than it costs to change threads."""
STREAMED = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
"""On answers that go on: nginx would wait for more."""
MSGPACK = "application/vnd.msgpack"
MSGPACK_TYPES = (MSGPACK, "application/msgpack", "application/x-msgpack")

Model = TypeVar("Model", bound=BaseModel)


def check_type(request: Request, *types: str) -> None:
    """Refuse a body of another type than the first of these, which the others are names of, or a compressed one."""
    media_type = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if media_type not in types:
        detail = f"send {types[0]}, not {media_type[:64] or 'an untyped body'}"
        raise Refused(Kind.UNSUPPORTED_MEDIA_TYPE, detail, "content-type")
    if "content-encoding" in request.headers:
        raise Refused(Kind.UNSUPPORTED_ENCODING, "bodies must not be compressed", "content-encoding")
    if any(coding.lower() != "chunked" for coding in request.headers.getlist("transfer-encoding")):
        detail = "bodies may come chunked, and not otherwise encoded"  # servers undo no other coding, and do not say so
        raise Refused(Kind.UNSUPPORTED_ENCODING, detail, "transfer-encoding")


async def read_json(request: Request, model: type[Model], context: Any = None) -> Model:
    """A JSON body, checked against a model, whose validators may ask for a context; a large one off the event loop.

    Raises
    ------
    Refused
        As `check_type` and `service.arriving.limits.read_bounded`; and if it is not JSON, a name comes twice in an
        object, or there are more than `MOST_VALUES`.
    RequestValidationError
        If it is not what the model says.
    """
    check_type(request, JSON)
    body = await read_bounded(request, JSON_BYTES)
    if len(body) <= SMALL_BYTES:
        return _parsed(body, model, context)
    took_s = list[float]()
    try:
        return await asyncio.to_thread(_timed, took_s, body, model, context)
    finally:  # hardly anything goes on meanwhile
        if (meter := request.scope.get("state", {}).get(METER)) is not None:
            meter.elsewhere(sum(took_s))


def described(model: type[BaseModel]) -> dict[str, Any]:
    """A JSON body in the OpenAPI description of a route that reads it with `read_json`."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})
    return {"requestBody": {"required": True, "content": {JSON: {"schema": _in_full(schema, definitions)}}}}


def _timed(took_s: list[float], body: bytes, model: type[Model], context: Any) -> Model:
    began = time.thread_time()
    try:
        return _parsed(body, model, context)
    finally:
        took_s.append(time.thread_time() - began)


def _parsed(body: bytes, model: type[Model], context: Any) -> Model:
    if body.count(b"[") + body.count(b"{") > MOST_VALUES:  # of which each is a value
        raise _too_many("body")
    try:
        plain = json.loads(body, object_pairs_hook=named_once)
    except (ValueError, RecursionError) as error:
        raise Refused(Kind.MALFORMED_JSON, f"not JSON: {error}") from None
    _check_number(plain, model)
    try:
        return model.model_validate_json(body, context=context)
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False, include_input=False)) from None


def _check_number(plain: Any, model: type[BaseModel]) -> None:
    left, number = [("body", plain)], 0
    while left:
        field, value = left.pop()
        if isinstance(value, dict):
            if len(value) > MOST_MEMBERS:
                detail = f"an object may have {MOST_MEMBERS} members, got {len(value)}"
                raise Refused(Kind.INVALID_REQUEST, detail, field)
            known = model.model_fields if value is plain else ()
            parts = [(name if name in known else field, part) for name, part in value.items()]
        elif isinstance(value, list):
            parts = [(field, part) for part in value[:MOST_VALUES]]
        else:
            continue
        number += len(value)
        if number > MOST_VALUES:
            raise _too_many(field)
        left += parts


def _too_many(field: str) -> Refused:
    return Refused(Kind.INVALID_REQUEST, f"at most {MOST_VALUES} values are allowed", field)


def _in_full(node: Any, definitions: dict[str, Any]) -> Any:
    """A schema with its definitions in the place of references, which OpenAPI would look for elsewhere."""
    if isinstance(node, list):
        return [_in_full(part, definitions) for part in node]
    if not isinstance(node, dict):
        return node
    parts = {name: _in_full(part, definitions) for name, part in node.items() if name not in ("$ref", "discriminator")}
    if "$ref" in node:
        parts = _in_full(definitions[node["$ref"].rpartition("/")[2]], definitions) | parts
    return parts
