"""One vehicle's side of the API."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections.abc import AsyncIterator, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import TypeAdapter, ValidationError

from clients.errors import ProtocolError
from clients.receipts import ReceiptBook
from clients.standby import Standby
from robosac import wire
from robosac.answers import FrameAnswer, LogReceipt, Typed
from robosac.detectors import Message, narrow
from robosac.possession import HEADER, make_proof
from robosac.recording.truth import Truth
from robosac.signatures import sign

MSGPACK = "application/vnd.msgpack"
SESSION_HEADER = "X-Session-Id"
RENEWAL_KEY_HEADER = "Idempotency-Key"
RECEIPT_HEADER, HEAD_HEADER = "Audit-Receipt", "Audit-Head"
AUDIT_PAGE = 1000
"""Audit records that are asked for at a time."""
T = TypeVar("T")


class _Accepted(Typed):
    frame: int | None = None
    receipt: LogReceipt | None = None


@dataclass(frozen=True)
class _ChangedTeam:
    teammate_tokens: dict[str, str]
    receipt: LogReceipt | None = None


@dataclass(frozen=True)
class RenewedToken:
    """A vehicle's fresh token, and when it expires (RFC 3339, UTC)."""

    token: str
    expires_at: str
    receipt: LogReceipt | None = None


_CHANGED, _RENEWED = TypeAdapter(_ChangedTeam), TypeAdapter(RenewedToken)
_STATE = TypeAdapter(dict[str, Any])
_STATE_RECEIPT = TypeAdapter[LogReceipt | None](LogReceipt | None)


class _Proving(httpx.Auth):
    """Proves with a request that the vehicle has its key."""

    def __init__(self, key: Ed25519PrivateKey, token: str) -> None:
        self._key = key
        self._token = token

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response, None]:
        request.headers[HEADER] = make_proof(self._key, request.method, str(request.url), self._token)
        yield request


class VehicleClient:
    """One vehicle in a session, speaking with its own token.

    Made by `GatewayClient.vehicle`. A teammate can only `send` and `renew`; the ego may call everything.
    """

    def __init__(
        self,
        request: Any,
        session_id: str,
        vehicle_id: str,
        token: str,
        key: Ed25519PrivateKey | None = None,
        receipts: ReceiptBook | None = None,
        events: Any = None,
        packing: wire.Packing | None = None,
    ) -> None:
        self._key = key
        self._packing = packing or wire.Packing()
        self._events = events
        self._standby: Standby | None = None
        self._receipts = receipts
        self.session_id = session_id
        self.vehicle_id = vehicle_id
        self._request = request
        self._path = f"/v1/sessions/{session_id}"
        self.token = token

    @property
    def bearer(self) -> dict[str, str]:
        """Headers that say who speaks, and in which session: some routers see no more than headers."""
        return {**bearer(self.token), SESSION_HEADER: self.session_id}

    @property
    def _proven(self) -> dict[str, Any]:
        """Options of a request that a stolen token must not be enough for."""
        proving = None if self._key is None else _Proving(self._key, self.token)
        return {"headers": self.bearer, "auth": proving}

    async def renew(self) -> RenewedToken:
        """Take a fresh token and speak with it from now on; the one before is worth nothing any more."""
        before, asked = self._promised, self._proven
        asked["headers"][RENEWAL_KEY_HEADER] = secrets.token_urlsafe(16)  # so that it can be asked again
        response = await self._request("POST", f"{self._path}/token", **asked)
        renewed = told(response, _RENEWED)
        self.token = renewed.token
        await self._keep(renewed.receipt, before)
        return renewed

    def signature(self, frame: int, message: Message) -> bytes | None:
        """The vehicle's signature over its message; None if it has no key."""
        if self._key is None:
            return None
        digest = wire.content_digest(frame, self.vehicle_id, message)
        return sign(self._key, self.session_id, self.vehicle_id, frame, digest)

    async def send(self, frame: int, message: Message) -> None:
        """As a teammate: post the own message for a frame."""
        await self.send_body(self._packed(frame, message))

    @contextlib.asynccontextmanager
    async def standing_by(self) -> AsyncIterator[Standby]:
        """As a teammate, for the length of a block: send again what a gateway process took and could not pass on."""
        self._standby = Standby(lambda: self._events(f"{self._path}/standby", self.bearer), self.send_body)
        running = asyncio.create_task(self._standby.run())
        try:
            yield self._standby
        finally:
            self._standby = None
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running

    async def send_body(self, body: bytes) -> None:
        """As `send`, with a body that is packed already."""
        standby = self._standby
        streams = 0 if standby is None else standby.streams
        content = (await self._post("messages", body)).content
        try:
            accepted = _Accepted.model_validate(wire.unpack(content, trusted=True))
        except (wire.WireError, ValidationError) as error:
            raise ProtocolError(f"not a receipt: {error}") from error
        await self._keep(accepted.receipt)
        if standby is not None and accepted.frame is not None:
            await standby.sent(accepted.frame, body, streams)

    async def ask(self, frame: int, message: Message, truth: Truth | None = None) -> FrameAnswer:
        """As the ego: post the own message and get the frame's answer, once the teammates' messages are in.

        What is true, where that is known, is for recordings alone.
        """
        return await self.ask_body(self._packed(frame, message, truth))

    async def ask_body(self, body: bytes) -> FrameAnswer:
        """As `ask`, with a body that is packed already."""
        return await self._answered("messages", body)

    async def post_frame(
        self,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        signatures: Mapping[str, bytes] | None = None,
        truth: Truth | None = None,
    ) -> FrameAnswer:
        """As the ego: post a whole frame, with the signatures that the teammates gave, and the truth as in `ask`."""
        told = None if truth is None else truth.as_fields()
        own, signed = self._rounded(ego), signatures or {}
        others = {name: each if name in signed else self._rounded(each) for name, each in teammates.items()}
        signature = self.signature(frame, own)
        body = wire.pack_frame(frame, own, others, signature, signatures, truth=told, packing=self._packing)
        return await self.post_frame_body(body)

    async def post_frame_body(self, body: bytes) -> FrameAnswer:
        """As `post_frame`, with a body that is packed already."""
        return await self._answered("frames", body)

    def _rounded(self, message: Message) -> Message:
        """A message as the gateway reads it: what is signed is that."""
        dtype = self._packing.dtype
        return message if dtype is None else narrow.rounded(message, dtype)

    def _packed(self, frame: int, message: Message, truth: Truth | None = None) -> bytes:
        own, told = self._rounded(message), None if truth is None else truth.as_fields()
        signature = self.signature(frame, own)
        return wire.pack_message(frame, self.vehicle_id, own, signature, told, self._packing)

    async def state(self) -> Mapping[str, Any]:
        """As the ego: the session's state."""
        state = told(await self._request("GET", self._path, headers=self.bearer), _STATE)
        try:
            receipt = _STATE_RECEIPT.validate_python(state.get("receipt"))
        except ValidationError as error:
            raise ProtocolError(f"the state's receipt is none: {error}") from error
        await self._keep(receipt)
        if receipt is not None and (receipt.seq, receipt.head) != (state.get("audit_seq"), state.get("audit_head")):
            raise ProtocolError("the state's receipt is not of the end of the log that the state tells")
        return state

    async def audit(self, after: int = 0) -> list[Mapping[str, Any]]:
        """As the ego: audit records with a number above ``after``, unpacked (`robosac.audit.expanded`)."""
        from robosac.audit import expanded  # noqa: PLC0415 (which needs scipy)

        try:
            return [expanded(json.loads(line)) for line in await self.audit_lines(after)]
        except ValueError as error:
            raise ProtocolError(f"not JSON Lines: {error}") from error

    async def audit_lines(self, after: int = 0) -> list[str]:
        """As `audit`, the lines as they are chained."""
        return [line async for line in self.stream_audit(after)]

    async def stream_audit(self, after: int = 0) -> AsyncIterator[str]:
        """As `audit_lines`, line by line: of a long log no more than a page is in memory."""
        while True:
            asked = {"after": after, "limit": AUDIT_PAGE}
            response = await self._request("GET", f"{self._path}/audit", params=asked, headers=self.bearer)
            *lines, rest = response.text.split("\n")  # and not where Unicode would also break a line
            if rest or not all(line.startswith("{") for line in lines):
                raise ProtocolError(f"not what {self._path}/audit answers: records, a line each")
            for line in lines:
                yield line
            after += len(lines)
            if len(lines) < AUDIT_PAGE:
                return

    async def kept_messages(self, frame: int) -> bytes:
        """As the ego: the messages of a decided frame as a whole frame, where the gateway keeps them."""
        path = f"{self._path}/frames/{frame}/messages"
        content: bytes = (await self._request("GET", path, headers=self.bearer)).content
        return content

    async def enrol(self, teammates: Sequence[str], public_keys: Mapping[str, str] | None = None) -> Mapping[str, str]:
        """As the ego: let teammates join; their tokens."""
        body, before = {"teammates": list(teammates), "public_keys": dict(public_keys or {})}, self._promised
        response = await self._request("POST", f"{self._path}/teammates", json=body, **self._proven)
        changed = told(response, _CHANGED)
        await self._keep(changed.receipt, before)
        return changed.teammate_tokens

    async def dismiss(self, teammate: str) -> None:
        """As the ego: let a teammate leave."""
        before = self._promised
        response = await self._request("DELETE", f"{self._path}/teammates/{teammate}", **self._proven)
        await self._keep(_receipt(response), before)

    async def close(self) -> str:
        """As the ego: end the session; the head of its audit log, to verify it against later."""
        response = await self._request("DELETE", self._path, **self._proven)
        receipt, head = _receipt(response), response.headers.get(HEAD_HEADER)
        await self._keep(receipt)
        if head is None:
            raise ProtocolError(f"the answer has no {HEAD_HEADER}")
        if receipt is not None and receipt.head != head:
            raise ProtocolError(f"{HEAD_HEADER} is {head:.64}, and {RECEIPT_HEADER} promises {receipt.head}")
        return str(head)

    async def _answered(self, what: str, body: bytes) -> FrameAnswer:
        before = self._promised
        answer = _answer(await self._post(what, body))
        await self._keep(answer.receipt, before)
        return answer

    @property
    def _promised(self) -> int:
        return 0 if self._receipts is None else self._receipts.promised(self.session_id)

    async def _keep(self, receipt: LogReceipt | None, after: int = 0) -> None:
        if self._receipts is not None:
            await self._receipts.take(receipt, self.session_id, after)

    async def _post(self, what: str, body: bytes) -> httpx.Response:
        headers = {**self.bearer, "Content-Type": MSGPACK, "Accept": MSGPACK}
        response: httpx.Response = await self._request("POST", f"{self._path}/{what}", content=body, headers=headers)
        return response


def bearer(credential: str) -> dict[str, str]:
    """The header that carries a key or a token."""
    return {"Authorization": f"Bearer {credential}"}


def _receipt(response: httpx.Response) -> LogReceipt | None:
    """The receipt of an answer without a body."""
    text = response.headers.get(RECEIPT_HEADER)
    try:
        return None if text is None else LogReceipt.model_validate_json(text)
    except ValidationError as error:
        raise ProtocolError(f"{RECEIPT_HEADER} is no receipt: {error}") from error


def _answer(response: httpx.Response) -> FrameAnswer:
    try:
        return FrameAnswer.model_validate(wire.unpack(response.content, trusted=True))
    except (wire.WireError, ValidationError) as error:
        raise ProtocolError(f"not a frame result: {error}") from error


def told(response: httpx.Response, kind: TypeAdapter[T]) -> T:
    """Read a response's JSON as a type; a `ProtocolError` if it is something else."""
    try:
        return kind.validate_json(response.content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ProtocolError(f"not what {response.request.url.path} answers: {where}: {first['msg']}") from None
