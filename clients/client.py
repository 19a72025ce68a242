"""A typed, asynchronous client of the gateway."""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import Any, TypedDict, Unpack

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import TypeAdapter

from clients.errors import NO_TYPE, GatewayError, GatewayUnreachable, ProtocolError, RequestRefused, refusal
from clients.receipts import ReceiptBook
from clients.vehicle import MSGPACK, RenewedToken, VehicleClient, bearer, told
from robosac.answers import FrameAnswer, LogReceipt
from robosac.wire import Packing

__all__ = [
    "API_KEY_VARIABLE",
    "MSGPACK",
    "FrameAnswer",
    "GatewayClient",
    "OpenedSession",
    "RenewedToken",
    "SessionOptions",
    "VehicleClient",
]

DEFAULT_TIMEOUT_S = 30.0
LIMITS = httpx.Limits(max_connections=None, max_keepalive_connections=256)
AGAIN_FOR_S, AGAIN_FIRST_S, AGAIN_EVERY_S = 1.0, 0.02, 0.2
"""How long a request is sent again where a gateway process ends and another takes it, or the database is away for a
moment, and with which pauses.
"""
DRAINING, STORE_UNAVAILABLE = "urn:robosac:problem:draining", "urn:robosac:problem:store-unavailable"
EVENTS = "text/event-stream"
SILENCE_S = 40.0
"""A stream on which nothing came for so long is broken."""
TRUST = "SSL_CERT_FILE may name a file with the certificate of an authority of your own"
API_KEY_VARIABLE = "ROBOSAC_API_KEY"
"""Where the command lines look for an API key: better than an option, which every process of the machine can read."""


class SessionOptions(TypedDict, total=False):
    """What a session may ask for; what is left out, or None, is left to the gateway.

    ``public_keys`` are those of the vehicles that sign (`robosac.signatures.show_public_key`).
    """

    detector: str | None
    defense: Mapping[str, Any] | None
    latency_budget_ms: float | None
    gather_ms: float | None
    frame_period_ms: float | None
    record: bool | None
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
    receipt: LogReceipt | None = None

    @property
    def lacks_witness(self) -> bool:
        """Whether the defence is to judge single objects, and the gateway says that the detector has no witness for it
        (``objects_judged`` of its ``calibration``).
        """
        calibration = self.detector.get("calibration") or {}
        return self.defense.get("judge_objects") is True and calibration.get("objects_judged") is False


@dataclass(frozen=True)
class _Keys:
    keys: list[Mapping[str, Any]]


@dataclass(frozen=True)
class _Detectors:
    detectors: list[Mapping[str, Any]]


_DETECTORS, _KEYS, _OPENED = TypeAdapter(_Detectors), TypeAdapter(_Keys), TypeAdapter(OpenedSession)


def _trusted(base_url: str) -> ssl.SSLContext:
    """Whose certificates are good. To read all authorities takes longer than some frames, so nobody is trusted where
    there is no TLS.
    """
    if base_url.lower().startswith("http:"):
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    return httpx.create_ssl_context()


class GatewayClient:
    """A connection to a gateway; an asynchronous context manager.

    Parameters
    ----------
    base_url : str
    api_key : str, optional
        To open sessions where the gateway asks for one; sent with nothing else.
    timeout_s : float
        For one request.
    gateway_keys : sequence of str, optional
        The gateway's public keys, base64, from a source that can be relied on; see `clients.receipts.ReceiptBook`.
    receipts : str or Path, optional
        File that the receipts of answers are added to.
    tls : ssl.SSLContext, optional
        Whose certificates are good; by default those in the file that ``SSL_CERT_FILE`` names, or else those of the
        well-known authorities (`certifi`).
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
        *,
        gateway_keys: Sequence[str] | None = None,
        receipts: str | Path | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._opener = {} if api_key is None else bearer(api_key)
        self._http = httpx.AsyncClient(
            base_url=base_url,
            timeout=timeout_s,
            limits=LIMITS,
            transport=transport,
            trust_env=False,
            verify=_trusted(base_url) if tls is None else tls,
        )
        self.receipts = ReceiptBook(self.public_keys, gateway_keys, None if receipts is None else Path(receipts))

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
        return told(await self._request("GET", "/v1/detectors"), _DETECTORS).detectors

    async def public_keys(self) -> list[str]:
        """The gateway's public keys, base64, the one that signs now first."""
        keys = told(await self._request("GET", "/v1/keys"), _KEYS).keys
        return [key["public_key"] for key in keys]

    async def open_session(
        self, ego_id: str, teammates: Sequence[str], **options: Unpack[SessionOptions]
    ) -> OpenedSession:
        """Open a session."""
        if isinstance(teammates, str):
            raise TypeError(f"teammates must be a sequence of ids, got {teammates!r}")
        asked = {name: value for name, value in options.items() if value is not None}
        body = {"ego_id": ego_id, "teammates": list(teammates), **asked}
        opened = told(await self._request("POST", "/v1/sessions", json=body, headers=self._opener), _OPENED)
        await self.receipts.take(opened.receipt, opened.session_id)
        return opened

    def vehicle(
        self,
        session_id: str,
        vehicle_id: str,
        token: str,
        key: Ed25519PrivateKey | None = None,
        packing: Packing | None = None,
    ) -> VehicleClient:
        """The client of one vehicle in a session. With a key it signs its messages, and proves that it has the key.
        By ``packing`` its maps travel in fewer bytes: in a type that the detector takes (``narrower`` in `detectors`),
        or compressed.
        """
        return VehicleClient(self._request, session_id, vehicle_id, token, key, self.receipts, self._events, packing)

    async def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        until, pause_s = time.monotonic() + AGAIN_FOR_S, AGAIN_FIRST_S
        while True:
            may_again = time.monotonic() + pause_s <= until
            async with self._reached(method, path):
                try:
                    response = await self._http.request(method, path, **options)
                except (httpx.ReadError, httpx.WriteError, httpx.RemoteProtocolError):
                    if not (may_again and _counts_once(method, path)):
                        raise
                else:
                    if response.is_success:
                        return response
                    if not (may_again and _is_to_be_sent_again(response, method, path)):
                        raise self._not_served(response)
            await asyncio.sleep(pause_s)
            if self._http.is_closed:
                raise GatewayUnreachable(f"{method} {path}: the client was closed before it could be sent again")
            pause_s = min(2 * pause_s, AGAIN_EVERY_S)

    async def _events(self, path: str, headers: Mapping[str, str]) -> AsyncIterator[tuple[str, Any]]:
        """Server-sent events, each a name and JSON, until the stream ends."""
        timeout = httpx.Timeout(SILENCE_S, connect=self._http.timeout.connect)
        async with (
            self._reached("GET", path),
            self._http.stream("GET", path, headers=headers, timeout=timeout) as response,
        ):
            if not response.is_success:
                await response.aread()
                raise self._not_served(response)
            if not response.headers.get("content-type", "").startswith(EVENTS):
                raise ProtocolError(f"{self._where(path)} answers no stream of events")
            name = ""
            async for line in response.aiter_lines():
                field, _, value = line.partition(": ")
                if field == "event":
                    name = value
                elif field == "data":
                    try:
                        said = json.loads(value)
                    except ValueError as error:
                        raise ProtocolError(f"{self._where(path)}: an event that is not JSON: {error}") from error
                    yield name, said

    @contextlib.asynccontextmanager
    async def _reached(self, method: str, path: str) -> AsyncIterator[None]:
        try:
            yield
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            where = f"{method} {self._where(path)}"
            hint = TRUST if "CERTIFICATE_VERIFY_FAILED" in str(error) else "is the gateway running?"
            raise GatewayUnreachable(f"{where}: {type(error).__name__} {error}; {hint}") from error

    def _where(self, path: str) -> str:
        return f"{_shown(self._http.base_url).rstrip('/')}{path}"

    def _not_served(self, response: httpx.Response) -> GatewayError:
        if response.has_redirect_location:
            where = f"{response.request.method} {_shown(response.request.url)}"
            return ProtocolError(f"{where} is redirected to {response.headers['location']}; ask there")
        return _refusal(response)


def _shown(url: httpx.URL) -> str:
    """A URL without a password."""
    return str(url.copy_with(userinfo=b""))


def _is_to_be_sent_again(response: httpx.Response, method: str, path: str) -> bool:
    """Whether a gateway process that is about to end has done nothing; or, of what counts once, whether a proxy lost a
    process before its answer, or the database was away.
    """
    why = _refusal(response).type if response.status_code == HTTPStatus.SERVICE_UNAVAILABLE else None
    lost = response.status_code == HTTPStatus.BAD_GATEWAY or why == STORE_UNAVAILABLE
    return why == DRAINING or (lost and _counts_once(method, path))


def _counts_once(method: str, path: str) -> bool:
    """Whether it does no harm to send a request again of which nobody knows what came of it: a message counts once, and
    a vehicle gets one fresh token however often it asks with one key.
    """
    return method == "GET" or path.endswith(("/messages", "/frames", "/token"))


def _refusal(response: httpx.Response) -> RequestRefused:
    with contextlib.suppress(ValueError):
        problem = response.json()
        if isinstance(problem, dict):
            return _told(response, problem)
    return _told(response, {})


def _told(response: httpx.Response, problem: Mapping[str, Any]) -> RequestRefused:
    retry = response.headers.get("retry-after", "")
    return refusal(response.status_code)(
        response.status_code,
        str(problem.get("type", NO_TYPE)),
        str(problem.get("detail", response.reason_phrase)),
        problem.get("field"),
        float(retry) if retry.isdecimal() else None,
    )
