"""The HTTP face of the gateway."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated

import structlog
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event
from pydantic import BaseModel
from starlette.types import Send

from robosac import wire
from robosac.answers import LogReceipt
from service import description
from service.arriving.arrival import arrival_of
from service.arriving.bodies import JSON_BYTES, MSGPACK, MSGPACK_TYPES, STREAMED, check_type, read_json
from service.arriving.limits import expected_bytes, hung_up, read_bounded
from service.callers import Ego, GatewayDep, KeyId, ProvenEgo, ProvenRenewing, Token, Vehicle
from service.deciding.asked import Answered
from service.errors import Kind, Refused
from service.gateway import Gateway
from service.problems import documented
from service.schemas import (
    ChangedTeam,
    DetectorEntry,
    DetectorList,
    EnrolmentRequest,
    GatewayKey,
    GatewayKeyList,
    Receipt,
    RenewedToken,
    SessionCreated,
    SessionRequest,
    SessionState,
)
from service.sessions.live import Caller, Standing
from service.sessions.moving import news
from service.sessions.pages import pieces
from service.sessions.room import Share

logger = structlog.stdlib.get_logger(__name__)

ACCEPT_CHARACTERS = 512
"""Of the header `Accept` that are looked at: a head may be so long that all of it would hold up everybody."""

v1 = APIRouter(prefix="/v1", responses={**description.AT_THE_DOORS, **documented(422, 503)})


class _Log(StreamingResponse):
    """Left unfinished if a page cannot be read: the server then hangs up, and what was sent does not look whole."""

    async def stream_response(self, send: Send) -> None:
        try:
            await super().stream_response(send)
        except Refused as refused:
            logger.warning("a log broke off while it was sent", why=refused.detail)


async def _session_request(request: Request, gateway: GatewayDep, key_id: KeyId) -> SessionRequest:
    with gateway.bodies.share(key_id, "").holding(expected_bytes(request, JSON_BYTES)):
        return await read_json(request, SessionRequest, gateway.sessions.defenses)


async def _enrolment_request(request: Request, gateway: GatewayDep, caller: ProvenEgo) -> EnrolmentRequest:
    with _room(gateway, caller).holding(expected_bytes(request, JSON_BYTES)):
        return await read_json(request, EnrolmentRequest)


async def _kept_messages(
    caller: Ego, gateway: GatewayDep, frame: Annotated[int, Path(ge=0, le=wire.MAX_FRAME)]
) -> AsyncIterator[bytes]:
    """They count as a body in hand until they are sent: whoever does not read them makes the gateway hold no more."""
    kept = await gateway.store.messages(caller.record.session_id, frame)
    if kept is None:
        raise Refused(Kind.MESSAGES_NOT_KEPT, "no messages of that frame are kept", "frame")
    with _room(gateway, caller).holding(len(kept)):
        yield kept


async def _standing(caller: Vehicle, gateway: GatewayDep) -> AsyncIterator[Standing]:
    with gateway.sessions.moving.standing_by(caller) as standing:
        yield standing


async def _standing_by(caller: Caller, gateway: Gateway, standing: Standing) -> AsyncIterator[bytes]:
    known = gateway.sessions.moving.known(caller)
    yield format_sse_event(event="standing", data_str=json.dumps(known))
    async for _ in news(standing):
        yield KEEPALIVE_COMMENT
    yield format_sse_event(event="end", data_str="{}")


_NO_STORE = {"Cache-Control": "no-store"}
"""On answers with tokens (RFC 6749, section 5.1)."""


@v1.get("/detectors", tags=["gateway"], responses=description.DETECTORS)
async def list_detectors(gateway: GatewayDep) -> DetectorList:
    """What each detector wants to be sent."""
    infos = [detector.info for detector in gateway.engine.detectors.values()]
    return DetectorList(detectors=[DetectorEntry.model_validate(info) for info in infos])


@v1.get("/keys", tags=["gateway"], responses=description.KEYS)
async def list_keys(gateway: GatewayDep) -> GatewayKeyList:
    """The gateway's public keys, with which receipts are checked."""
    keys = [GatewayKey(key_id=name, public_key=key, signs=signs) for name, key, signs in gateway.keys.published()]
    return GatewayKeyList(keys=keys)


@v1.post(
    "/sessions",
    status_code=201,
    tags=["sessions"],
    openapi_extra=description.body(SessionRequest),
    responses=description.OPENED,
)
async def open_session(
    request: Annotated[SessionRequest, Depends(_session_request)],
    gateway: GatewayDep,
    key_id: KeyId,
    response: Response,
) -> SessionCreated:
    """Open a session of one ego with its teammates. The tokens are shown only in this answer."""
    response.headers.update(_NO_STORE)
    gateway.recorder.check(asked=request.record)
    opened = await gateway.opening.open(request, key_id)
    recorded = await gateway.recorder.begin(opened.session_id, asked=request.record)
    return opened.model_copy(update={"recorded": recorded})


@v1.get("/sessions/{sid}", tags=["sessions"], responses=description.STATE)
async def get_session(caller: Ego, gateway: GatewayDep) -> SessionState:
    """The session's settings and what its defence remembers."""
    return await gateway.sessions.describe(caller)


@v1.delete(
    "/sessions/{sid}",
    status_code=204,
    tags=["sessions"],
    responses=description.ENDED,
)
async def delete_session(caller: ProvenEgo, gateway: GatewayDep, response: Response) -> None:
    """End the session; its log can be read until it is purged. The header `Audit-Head` is its last record's hash, and
    `Audit-Receipt` the same, signed.
    """
    receipt = await gateway.sessions.close(caller)
    response.headers.update({"Audit-Head": receipt.head, **_promised(receipt)})


@v1.post(
    "/sessions/{sid}/token",
    status_code=201,
    tags=["sessions"],
    responses=description.RENEWED,
)
async def renew_token(renewing: ProvenRenewing, gateway: GatewayDep, response: Response) -> RenewedToken:
    """A fresh token for the vehicle that asks; the one it asks with is worth nothing any more. With
    `Idempotency-Key` the vehicle can ask again if the answer was lost.
    """
    response.headers.update(_NO_STORE)
    return await gateway.teams.renew(renewing.caller, renewing.key)


@v1.post(
    "/sessions/{sid}/teammates",
    status_code=201,
    tags=["sessions"],
    openapi_extra=description.body(EnrolmentRequest),
    responses=description.JOINED,
)
async def enrol_teammates(
    request: Annotated[EnrolmentRequest, Depends(_enrolment_request)],
    caller: ProvenEgo,
    gateway: GatewayDep,
    response: Response,
) -> ChangedTeam:
    """Let teammates join from the next frame on. Their tokens are shown only in this answer."""
    response.headers.update(_NO_STORE)
    return await gateway.teams.enrol(caller, request.teammates, request.public_keys)


@v1.delete(
    "/sessions/{sid}/teammates/{vehicle_id}",
    status_code=204,
    tags=["sessions"],
    responses=description.LEFT,
)
async def dismiss_teammate(vehicle_id: str, caller: ProvenEgo, gateway: GatewayDep, response: Response) -> None:
    """Let a teammate leave from the next frame on; its token is worth nothing any more. The header `Audit-Receipt` is
    the log's end, signed.
    """
    response.headers.update(_promised(await gateway.teams.dismiss(caller, vehicle_id)))


@v1.get(
    "/sessions/{sid}/audit",
    response_class=Response,
    tags=["audit"],
    responses=description.AUDIT,
)
async def get_audit(
    sid: str,
    gateway: GatewayDep,
    token: Token,
    after: Annotated[int, Query(ge=0, le=2**53)] = 0,
    limit: Annotated[int, Query(ge=1, le=2**53)] = 2**53,
) -> Response:
    """The audit log as JSON Lines: at most `limit` records with a number above `after`; of an ended session, too."""
    pages = await gateway.sessions.audit_log(sid, token, after, limit)
    return _Log(pages, media_type=description.JSONL)


@v1.post(
    "/sessions/{sid}/messages",
    tags=["frames"],
    openapi_extra=description.OF_TENSORS,
    responses=description.TAKEN,
    response_class=Response,
)
async def post_message(
    request: Request, caller: Vehicle, gateway: GatewayDep, accept: Annotated[str | None, Header()] = None
) -> Response:
    """A vehicle's own message. The ego's starts the fusion and is answered with the frame result."""
    limit = gateway.frames.body_limit(caller, whole_frame=False)
    gateway.frames.check_waiting(caller)
    with (room := _room(gateway, caller)).holding(expected_bytes(request, limit)):
        body = await _read_body(request, caller, gateway, limit)
        gone, arrived = partial(hung_up, request), arrival_of(request.scope)
        answer = await gateway.frames.post_message(caller, body, arrived, room, gone)
    return _negotiated(answer, accept, 202) if isinstance(answer, Receipt) else _handed_over(answer, accept, gateway)


@v1.post(
    "/sessions/{sid}/frames",
    tags=["frames"],
    openapi_extra=description.OF_TENSORS,
    responses=description.DECIDED,
    response_class=Response,
)
async def post_frame(
    request: Request, caller: Ego, gateway: GatewayDep, accept: Annotated[str | None, Header()] = None
) -> Response:
    """A whole frame in one request by the ego."""
    limit, arrived = gateway.frames.body_limit(caller, whole_frame=True), arrival_of(request.scope)
    with (
        gateway.frames.coming(caller, arrived) as expected,
        (room := _room(gateway, caller)).holding(expected_bytes(request, limit)),
    ):
        body = await _read_body(request, caller, gateway, limit)
        answer = await gateway.frames.post_frame(caller, body, arrived, room, expected)
    return _handed_over(answer, accept, gateway)


@v1.get("/sessions/{sid}/standby", response_class=Response, tags=["frames"], responses=description.STANDING_BY)
async def stand_by(
    caller: Vehicle, gateway: GatewayDep, standing: Annotated[Standing, Depends(_standing)]
) -> EventSourceResponse:
    """Server-sent events for a vehicle that sends again what was lost: which of its messages wait, and the end."""
    return EventSourceResponse(_standing_by(caller, gateway, standing), headers=STREAMED)


@v1.get(
    "/sessions/{sid}/frames/{frame}/messages",
    response_class=Response,
    tags=["audit"],
    responses=description.KEPT,
)
async def get_messages(kept: Annotated[bytes, Depends(_kept_messages)]) -> Response:
    """The messages of a decided frame as a whole frame, where the gateway keeps them, to replay the decision."""
    return StreamingResponse(pieces(kept), media_type=MSGPACK, headers={"Content-Length": str(len(kept))})


def _room(gateway: Gateway, caller: Caller) -> Share:
    """What a body of a vehicle may take of the room for all."""
    return gateway.bodies.share(caller.record.key_id, caller.record.session_id, caller.vehicle_id)


async def _read_body(request: Request, caller: Caller, gateway: Gateway, limit: int) -> bytes:
    """The body of a tensor request, read only as far as the detector's layout allows; a refusal goes on record."""
    try:
        check_type(request, *MSGPACK_TYPES)
        gateway.admission.expect(caller.live.key, caller.record.session_id)
        async with caller.live.unread[caller.vehicle_id].one_more() as came:
            return await read_bounded(request, limit, came)
    except Refused as refused:
        await gateway.frames.refuse(caller, refused)
        raise


def _promised(receipt: LogReceipt) -> dict[str, str]:
    """What carries a receipt where an answer has no body."""
    return {"Audit-Receipt": receipt.model_dump_json()}


def _handed_over(answered: Answered, accept: str | None, gateway: Gateway) -> Response:
    """An answer that says whether it is in time, decided as late as can be: with its bytes ready to be sent."""
    answer = answered.now()
    response = _negotiated(answer, accept)
    if answer.deadline_met and not answered.in_time:
        answer = answered.now()
        response = _negotiated(answer, accept)
    if answered.answer.deadline_met and not answer.deadline_met:
        answered.asked.caller.live.late.append(answer.frame)
    gateway.frames.deciding.tell(answered, answer)
    gateway.recorder.note(answered, answer)
    return response


def _negotiated(answer: BaseModel, accept: str | None, status: int = 200) -> Response:
    """msgpack where the client names it before JSON, else JSON."""
    for media_range in (accept or "")[:ACCEPT_CHARACTERS].lower().split(","):
        media_type, *parameters = (part.strip() for part in media_range.split(";"))
        if any(re.fullmatch(r"q=0(\.0*)?", parameter) for parameter in parameters):
            continue
        if media_type in MSGPACK_TYPES:
            return Response(wire.pack(answer.model_dump(mode="json")), status, media_type=MSGPACK)
        if media_type in ("application/json", "application/*", "*/*"):
            break
    return Response(answer.model_dump_json(), status, media_type="application/json")
