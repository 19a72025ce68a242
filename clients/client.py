"""A typed, asynchronous client of the gateway."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypedDict, TypeVar, Unpack

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import TypeAdapter, ValidationError

from clients.errors import GatewayError, GatewayUnreachable, ProtocolError, refusal
from robosac import wire
from robosac.answers import FrameAnswer
from robosac.detectors import Message
from robosac.signatures import sign

MSGPACK = "application/vnd.msgpack"
DEFAULT_TIMEOUT_S = 30.0
API_KEY_VARIABLE = "ROBOSAC_API_KEY"
"""Where the command lines look for an API key: better than an option, which every process of the machine can read."""


T = TypeVar("T")


class SessionOptions(TypedDict, total=False):
    """What a session may ask for; what is left out, or None, is left to the gateway.

    ``public_keys`` are those of the vehicles that sign (`robosac.signatures.show_public_key`).
    """

    detector: str | None
    defense: Mapping[str, Any] | None
    latency_budget_ms: float | None
    gather_ms: float | None
    frame_period_ms: float | None
    public_keys: Mapping[str, str] | None


@dataclass(frozen=True)
class OpenedSession:
    """A new session and the tokens of its vehicles."""

    session_id: str
    ego_token: str
    teammate_tokens: Mapping[str, str]
    tokens_expire_at: str
    detector: Mapping[str, Any]
    defense: Mapping[str, Any]


@dataclass(frozen=True)
class _Detectors:
    detectors: list[Mapping[str, Any]]


@dataclass(frozen=True)
class _ChangedTeam:
    teammate_tokens: dict[str, str]


@dataclass(frozen=True)
class RenewedToken:
    """A vehicle's fresh token, and when it expires (RFC 3339, UTC)."""

    token: str
    expires_at: str


class GatewayClient:
    """A connection to a gateway; an asynchronous context manager.

    Parameters
    ----------
    base_url : str
    api_key : str, optional
        To open sessions where the gateway asks for one; sent with nothing else.
    timeout_s : float
        For one request.
    transport : httpx.AsyncBaseTransport, optional
        For tests: `httpx.ASGITransport` talks to an app without a socket.

    Examples
    --------
    ::

        async with GatewayClient("http://127.0.0.1:8000") as gateway:
            session = await gateway.open_session("car-1", ["car-2", "rsu"])
            ego = gateway.vehicle(session.session_id, "car-1", session.ego_token)
            answer = await ego.post_frame(0, own_message, {"car-2": message})
    """

    def __init__(
        self,
        base_url: str,
        api_key: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._opener = {} if api_key is None else _bearer(api_key)
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=256)
        self._http = httpx.AsyncClient(
            base_url=base_url, timeout=timeout_s, limits=limits, transport=transport, trust_env=False
        )

    async def __aenter__(self) -> GatewayClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    async def ready(self) -> bool:
        """Whether the gateway is up and warm."""
        try:
            await self._request("GET", "/readyz")
        except GatewayError:
            return False
        return True

    async def detectors(self) -> list[Mapping[str, Any]]:
        """The gateway's detectors and their message layouts."""
        return _told(await self._request("GET", "/v1/detectors"), _Detectors).detectors

    async def open_session(
        self, ego_id: str, teammates: Sequence[str], **options: Unpack[SessionOptions]
    ) -> OpenedSession:
        """Open a session."""
        asked = {name: value for name, value in options.items() if value is not None}
        body = {"ego_id": ego_id, "teammates": list(teammates), **asked}
        return _told(await self._request("POST", "/v1/sessions", json=body, headers=self._opener), OpenedSession)

    def vehicle(
        self, session_id: str, vehicle_id: str, token: str, key: Ed25519PrivateKey | None = None
    ) -> VehicleClient:
        """The client of one vehicle in a session, signing its messages where it has a key."""
        return VehicleClient(self._request, session_id, vehicle_id, token, key)

    async def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            response = await self._http.request(method, path, **options)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            where = f"{method} {self._http.base_url.join(path)}"
            raise GatewayUnreachable(f"{where}: {type(error).__name__} {error}; is the gateway running?") from error
        if response.is_success:
            return response
        try:
            problem = response.json()
        except ValueError:
            problem = None
        if not isinstance(problem, dict):
            problem = {}
        retry = response.headers.get("retry-after", "")
        raise refusal(response.status_code)(
            response.status_code,
            str(problem.get("type", "about:blank")),
            str(problem.get("detail", response.reason_phrase)),
            problem.get("field"),
            float(retry) if retry.isdecimal() else None,
        )


class VehicleClient:
    """One vehicle in a session, speaking with its own token.

    Made by `GatewayClient.vehicle`. A teammate can only `send` and `renew`; the ego may call everything.
    """

    def __init__(
        self, request: Any, session_id: str, vehicle_id: str, token: str, key: Ed25519PrivateKey | None = None
    ) -> None:
        self._key = key
        self.session_id = session_id
        self.vehicle_id = vehicle_id
        self._request = request
        self._path = f"/v1/sessions/{session_id}"
        self.token = token

    @property
    def bearer(self) -> dict[str, str]:
        """The header that says who speaks."""
        return _bearer(self.token)

    async def renew(self) -> RenewedToken:
        """Take a fresh token and speak with it from now on; the one before is worth nothing any more."""
        response = await self._request("POST", f"{self._path}/token", headers=self.bearer)
        renewed = _told(response, RenewedToken)
        self.token = renewed.token
        return renewed

    def signature(self, frame: int, message: Message) -> bytes | None:
        """The vehicle's signature over its message; None if it has no key."""
        if self._key is None:
            return None
        return sign(self._key, self.session_id, wire.content_digest(frame, self.vehicle_id, message))

    async def send(self, frame: int, message: Message) -> None:
        """As a teammate: post the own message for a frame."""
        await self.send_body(wire.pack_message(frame, self.vehicle_id, message, self.signature(frame, message)))

    async def send_body(self, body: bytes) -> None:
        """As `send`, with a body that is packed already."""
        await self._post("messages", body)

    async def ask(self, frame: int, message: Message) -> FrameAnswer:
        """As the ego: post the own message and get the frame's answer, once the teammates' messages are in."""
        body = wire.pack_message(frame, self.vehicle_id, message, self.signature(frame, message))
        return _answer(await self._post("messages", body))

    async def post_frame(
        self,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        signatures: Mapping[str, bytes] | None = None,
    ) -> FrameAnswer:
        """As the ego: post a whole frame, with the signatures that the teammates gave."""
        body = wire.pack_frame(frame, ego, teammates, self.signature(frame, ego), signatures)
        return await self.post_frame_body(body)

    async def post_frame_body(self, body: bytes) -> FrameAnswer:
        """As `post_frame`, with a body that is packed already."""
        return _answer(await self._post("frames", body))

    async def state(self) -> Mapping[str, Any]:
        """As the ego: the session's state."""
        return _told(await self._request("GET", self._path, headers=self.bearer), dict[str, Any])

    async def audit(self, after: int = 0) -> list[Mapping[str, Any]]:
        """As the ego: audit records with a number above ``after``."""
        try:
            return [json.loads(line) for line in await self.audit_lines(after)]
        except ValueError as error:
            raise ProtocolError(f"not JSON Lines: {error}") from error

    async def audit_lines(self, after: int = 0) -> list[str]:
        """As `audit`, the lines as they are chained."""
        response = await self._request("GET", f"{self._path}/audit", params={"after": after}, headers=self.bearer)
        text: str = response.text
        return text.split("\n")[:-1]  # and not where Unicode would also break a line

    async def kept_messages(self, frame: int) -> bytes:
        """As the ego: the messages of a decided frame as a whole frame, where the gateway keeps them."""
        path = f"{self._path}/frames/{frame}/messages"
        content: bytes = (await self._request("GET", path, headers=self.bearer)).content
        return content

    async def enrol(self, teammates: Sequence[str], public_keys: Mapping[str, str] | None = None) -> Mapping[str, str]:
        """As the ego: let teammates join; their tokens."""
        body = {"teammates": list(teammates), "public_keys": dict(public_keys or {})}
        response = await self._request("POST", f"{self._path}/teammates", json=body, headers=self.bearer)
        return _told(response, _ChangedTeam).teammate_tokens

    async def dismiss(self, teammate: str) -> None:
        """As the ego: let a teammate leave."""
        await self._request("DELETE", f"{self._path}/teammates/{teammate}", headers=self.bearer)

    async def close(self) -> str:
        """As the ego: end the session; the head of its audit log, to verify it against later."""
        response = await self._request("DELETE", self._path, headers=self.bearer)
        return str(response.headers.get("audit-head", ""))

    async def _post(self, what: str, body: bytes) -> httpx.Response:
        headers = {**self.bearer, "Content-Type": MSGPACK, "Accept": MSGPACK}
        response: httpx.Response = await self._request("POST", f"{self._path}/{what}", content=body, headers=headers)
        return response


def _bearer(credential: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {credential}"}


def _answer(response: httpx.Response) -> FrameAnswer:
    try:
        return FrameAnswer.model_validate(wire.unpack(response.content, trusted=True))
    except (wire.WireError, ValidationError) as error:
        raise ProtocolError(f"not a frame result: {error}") from error


def _told(response: httpx.Response, kind: type[T]) -> T:
    """Read a response's JSON as a type; a `ProtocolError` if it is something else."""
    try:
        return TypeAdapter(kind).validate_json(response.content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ProtocolError(f"not what {response.request.url.path} answers: {where}: {first['msg']}") from None
