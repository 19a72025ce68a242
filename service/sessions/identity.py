"""Who may call: API keys that open sessions, tokens of the vehicles in them, and loopback only where there are no keys.

A token is a signed JWT (RFC 7519, HS256) that binds a vehicle to a session and a role. The session's record holds the
id of the one token of each vehicle that counts, so that a token can be revoked before it expires.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any

import jwt
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.keeping.store import SessionRecord, Store
from service.problems import Problem
from service.settings import Settings

API_KEY_LENGTH = 16
SECRET_LENGTH = 32
TOKEN_BYTES = 4096
"""A longer token is not looked at."""
LEEWAY_S = 5.0
"""How far the clocks of two gateways may be apart."""
ISSUER = AUDIENCE = "robosac-gateway"
ALGORITHM = "HS256"
CLAIMS = ("iss", "aud", "sub", "sid", "role", "jti", "iat", "exp")
OPEN_PATHS = ("/healthz",)
_BEARER_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]+=*")  # RFC 6750, section 2.1
_CHALLENGE = {"WWW-Authenticate": "Bearer"}


def unauthenticated(detail: str) -> Problem:
    """The refusal of a caller without a credential that counts."""
    return Problem(401, "unauthenticated", detail, headers=_CHALLENGE)


class ApiKeys:
    """The keys of those who may open sessions; without any, everybody may.

    Parameters
    ----------
    keys : sequence of str
    """

    def __init__(self, keys: Sequence[str]) -> None:
        self._digests = [sha256(key.encode()).digest() for key in keys]

    @staticmethod
    def read(settings: Settings) -> list[str]:
        """The keys of the settings and of the file that they name.

        Raises
        ------
        ValueError
            If the file cannot be read or holds no key, or a key is too short or could not be sent; no key is shown.
        """
        named = [(f"ROBOSAC_API_KEYS: key {i}", key.get_secret_value()) for i, key in enumerate(settings.api_keys, 1)]
        path = settings.api_keys_file
        if path is not None:
            try:
                lines = [line.strip() for line in path.read_text().splitlines()]
            except (OSError, UnicodeError) as error:
                raise ValueError(f"ROBOSAC_API_KEYS_FILE: {path} cannot be read: {type(error).__name__}") from error
            found = [(f"ROBOSAC_API_KEYS_FILE: line {i}", line) for i, line in enumerate(lines, 1) if line]
            if not found:
                raise ValueError(f"ROBOSAC_API_KEYS_FILE: {path} holds no key")
            named += found
        for where, key in named:
            if len(key) < API_KEY_LENGTH:
                raise ValueError(f"{where} has fewer than {API_KEY_LENGTH} characters")
            if not _BEARER_TOKEN.fullmatch(key):
                raise ValueError(f"{where} has characters other than A-Z a-z 0-9 . _ ~ + / - and = at the end")
        return [key for _, key in named]

    def __bool__(self) -> bool:
        return bool(self._digests)

    def check(self, key: str | None) -> None:
        """Refuse whoever has none of the keys. Every key is compared, so that the time tells nothing.

        Raises
        ------
        Problem
            401.
        """
        if not self:
            return
        given = sha256((key or "").encode()).digest()
        matches = [hmac.compare_digest(given, digest) for digest in self._digests]
        if not any(matches):
            raise unauthenticated("an API key is needed as a bearer token")


class LoopbackOnly:
    """Serves this machine only, but for `OPEN_PATHS`: for a gateway whose sessions anybody can open."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] in OPEN_PATHS or is_local(scope):
            await self._app(scope, receive, send)
            return
        detail = "without an API key the gateway serves its own machine only; set ROBOSAC_API_KEYS"
        refusal = Problem(403, "loopback-only", detail, headers={"Connection": "close"})  # and takes no body
        await refusal.response()(scope, receive, send)


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


@dataclass(frozen=True)
class Token:
    """A new token.

    Attributes
    ----------
    text : str
        What the vehicle sends.
    token_id : str
        What the session's record keeps (the claim ``jti``).
    expires_at : str
        RFC 3339, UTC.
    """

    text: str = field(repr=False)
    token_id: str
    expires_at: str


class TokenRefused(Exception):
    """A token that does not count.

    Attributes
    ----------
    problem : Problem
        401.
    vehicle_id : str or None
        Whose token it is or was; None unless this gateway signed it for the session.
    """

    def __init__(self, problem: Problem, vehicle_id: str | None = None) -> None:
        super().__init__(problem.detail)
        self.problem = problem
        self.vehicle_id = vehicle_id


class Tokens:
    """Signs and reads the tokens of vehicles.

    Parameters
    ----------
    signing_secrets : sequence of str
        The first signs, all verify. With none, `start` takes the one that the store keeps.
    ttl_s : float
        How long a token lives.
    """

    def __init__(self, signing_secrets: Sequence[str], ttl_s: float) -> None:
        self._secrets = tuple(signing_secrets)
        self._ttl_s = ttl_s

    @classmethod
    def configured(cls, settings: Settings) -> Tokens:
        """Those of the settings.

        Raises
        ------
        ValueError
            If a secret is too short; it is not shown.
        """
        own = [secret.get_secret_value() for secret in settings.token_secrets]
        for number, secret in enumerate(own, 1):
            if len(secret) < SECRET_LENGTH:
                raise ValueError(f"ROBOSAC_TOKEN_SECRETS: secret {number} has fewer than {SECRET_LENGTH} characters")
        return cls(own, settings.token_ttl_s)

    async def start(self, store: Store) -> None:
        """Make sure that there is a secret, the same after a restart."""
        if not self._secrets:
            self._secrets = (await store.secret("token-signing", lambda: secrets.token_urlsafe(48)),)

    def issue(self, session_id: str, vehicle_id: str, *, is_ego: bool) -> Token:
        """A token of a vehicle for a session."""
        now = int(time.time())
        expires = now + int(self._ttl_s)
        token_id = secrets.token_hex(16)
        claims = {
            "iss": ISSUER,
            "aud": AUDIENCE,
            "sub": vehicle_id,
            "sid": session_id,
            "role": _role(is_ego),
            "jti": token_id,
            "iat": now,
            "exp": expires,
        }
        expires_at = datetime.fromtimestamp(expires, UTC).isoformat().replace("+00:00", "Z")
        return Token(jwt.encode(claims, self._secrets[0], ALGORITHM), token_id, expires_at)

    def holder(self, record: SessionRecord, text: str | None) -> str:
        """The vehicle that may speak in a session with this token.

        Raises
        ------
        TokenRefused
            If it is none of this session, not the vehicle's latest, or expired.
        """
        claims = self._claims(text)
        if claims is None or claims["sid"] != record.session_id:
            raise TokenRefused(unauthenticated("a bearer token of a vehicle of this session is needed"))
        vehicle: str = claims["sub"]
        is_latest = record.token_ids.get(vehicle) == claims["jti"]
        if not is_latest or claims["role"] != _role(vehicle == record.ego_id):
            raise TokenRefused(unauthenticated("the token was renewed, or its vehicle has left"), vehicle)
        if claims["exp"] <= time.time() - LEEWAY_S:
            raise TokenRefused(Problem(401, "token-expired", "the token has expired", headers=_CHALLENGE), vehicle)
        return vehicle

    def _claims(self, text: str | None) -> Mapping[str, Any] | None:
        """What a token says, expired or not; None unless it is one that this gateway signed."""
        if not text or len(text) > TOKEN_BYTES:
            return None
        for secret in self._secrets:
            try:
                claims: Mapping[str, Any] = jwt.decode(
                    text,
                    secret,
                    algorithms=[ALGORITHM],
                    audience=AUDIENCE,
                    issuer=ISSUER,
                    leeway=LEEWAY_S,
                    options={"require": list(CLAIMS), "strict_aud": True, "verify_exp": False},
                )
            except jwt.InvalidSignatureError:
                continue
            except (jwt.PyJWTError, ValueError, RecursionError):  # what is not a token at all may fail in any way
                return None
            return claims if isinstance(claims["exp"], int) else None
        return None


def _role(is_ego: bool) -> str:
    return "ego" if is_ego else "teammate"
