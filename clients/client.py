"""A typed, asynchronous client of the gateway."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypedDict, Unpack

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from clients.errors import GatewayError, GatewayUnreachable, refusal
from clients.receipts import ReceiptBook
from clients.vehicle import MSGPACK, RenewedToken, VehicleClient, bearer, told
from robosac.answers import FrameAnswer, LogReceipt

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


@dataclass(frozen=True)
class _Keys:
    keys: list[Mapping[str, Any]]


@dataclass(frozen=True)
class _Detectors:
    detectors: list[Mapping[str, Any]]


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
    receipts : Path, optional
        File that the receipts of answers are added to.
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
        receipts: Path | None = None,
    ) -> None:
        self._opener = {} if api_key is None else bearer(api_key)
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=256)
        self._http = httpx.AsyncClient(
            base_url=base_url, timeout=timeout_s, limits=limits, transport=transport, trust_env=False
        )
        self.receipts = ReceiptBook(self.public_keys, gateway_keys, receipts)

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
        return told(await self._request("GET", "/v1/detectors"), _Detectors).detectors

    async def public_keys(self) -> list[str]:
        """The gateway's public keys, base64, the one that signs now first."""
        keys = told(await self._request("GET", "/v1/keys"), _Keys).keys
        return [key["public_key"] for key in keys]

    async def open_session(
        self, ego_id: str, teammates: Sequence[str], **options: Unpack[SessionOptions]
    ) -> OpenedSession:
        """Open a session."""
        asked = {name: value for name, value in options.items() if value is not None}
        body = {"ego_id": ego_id, "teammates": list(teammates), **asked}
        opened = told(await self._request("POST", "/v1/sessions", json=body, headers=self._opener), OpenedSession)
        await self.receipts.take(opened.receipt, opened.session_id)
        return opened

    def vehicle(
        self, session_id: str, vehicle_id: str, token: str, key: Ed25519PrivateKey | None = None
    ) -> VehicleClient:
        """The client of one vehicle in a session. With a key it signs its messages, and proves that it has the key."""
        return VehicleClient(self._request, session_id, vehicle_id, token, key, self.receipts)

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
