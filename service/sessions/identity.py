"""Who may call: API keys that open sessions, and tokens of the vehicles in them.

A token is a signed JWT (RFC 7519, HS256) that binds a vehicle to a session and a role. The session's record holds the
id of the one token of each vehicle that counts, so that a token can be revoked before it expires.
"""

from __future__ import annotations

import asyncio
import base64
import hmac
import json
import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any, NamedTuple

import jwt

from robosac.faults import unreadable
from service.errors import RENEWED, Kind, Refused, TokenRefused
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.settings import Settings

API_KEY_LENGTH = 16
SECRET_LENGTH = 32
KEY_ID_LENGTH = 16
TOKEN_BYTES = 4096
"""A longer token is not looked at."""
LEEWAY_S = 10.0
"""How far the clocks of two gateways may be apart."""
ISSUER = AUDIENCE = "robosac-gateway"
ALGORITHM = "HS256"
CLAIMS = ("iss", "aud", "sub", "sid", "role", "jti", "iat", "exp")
RENEWAL_KEY = r"^[!-~]{16,256}$"
"""What a vehicle may choose so that it can ask again for the same fresh token."""
_BEARER_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]+=*")  # RFC 6750, section 2.1


def check_secret(where: str, secret: str) -> None:
    """Refuse a secret of the settings that is too short, or could not be sent; it is not shown.

    Raises
    ------
    ValueError
        It says ``where`` the secret stands.
    """
    if len(secret) < API_KEY_LENGTH:
        raise ValueError(f"{where} has fewer than {API_KEY_LENGTH} characters")
    if not _BEARER_TOKEN.fullmatch(secret):
        raise ValueError(f"{where} has characters other than A-Z a-z 0-9 . _ ~ + / - and = at the end")


def is_among(given: str | None, digests: Sequence[bytes]) -> bool:
    """Whether a secret is one of those with these SHA-256; every one is compared, so that the time tells nothing."""
    digest = sha256((given or "").encode()).digest()
    matches = [hmac.compare_digest(digest, known) for known in digests]
    return any(matches)


class ApiKeys:
    """The keys of those who may open sessions; without any, everybody may."""

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
                raise ValueError(f"ROBOSAC_API_KEYS_FILE: {path} cannot be read: {unreadable(error)}") from error
            found = [(f"ROBOSAC_API_KEYS_FILE: line {i}", line) for i, line in enumerate(lines, 1) if line]
            if not found:
                raise ValueError(f"ROBOSAC_API_KEYS_FILE: {path} holds no key")
            named += found
        for where, key in named:
            check_secret(where, key)
        return [key for _, key in named]

    def __bool__(self) -> bool:
        return bool(self._digests)

    def __len__(self) -> int:
        return len(self._digests)

    def check(self, key: str | None) -> str:
        """Refuse whoever has none of the keys. Every key is compared, so that the time tells nothing.

        Returns
        -------
        str
            What sessions that the key opens are known by as the key's; empty where no key is asked for.

        Raises
        ------
        Refused
            With the kind ``unauthenticated``.
        """
        if not self:
            return ""
        key_id = self.id_of(key)
        if key_id is None:
            raise Refused(Kind.UNAUTHENTICATED, "an API key is needed as a bearer token")
        return key_id

    def id_of(self, key: str | None) -> str | None:
        """What sessions that a key opens are known by, or None if it is none of the keys."""
        if not is_among(key, self._digests):
            return None
        given = sha256((key or "").encode()).digest()
        return sha256(b"robosac key of a session\0" + given).hexdigest()[:KEY_ID_LENGTH]


@dataclass(frozen=True)
class Token:
    """A new token."""

    text: str = field(repr=False)
    """What the vehicle sends."""
    token_id: str
    """What the session's record keeps (the claim ``jti``)."""
    expires_at: str
    """RFC 3339, UTC."""


class Tokens:
    """Signs and reads the tokens of vehicles. The first of the settings' secrets signs, all verify.

    Parameters
    ----------
    settings : Settings
    clock : callable
        Unix time, seconds.

    Raises
    ------
    ValueError
        If a secret is too short; it is not shown.
    """

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.time) -> None:
        self._secrets = tuple(secret.get_secret_value() for secret in settings.token_secrets)
        self._ttl_s = settings.token_ttl_s
        self.clock = clock
        for number, secret in enumerate(self._secrets, 1):
            if len(secret) < SECRET_LENGTH:
                raise ValueError(f"ROBOSAC_TOKEN_SECRETS: secret {number} has fewer than {SECRET_LENGTH} characters")

    async def start(self, store: Store) -> None:
        """Where the settings name no secret, take the one that the store keeps: the same after a restart."""
        if not self._secrets:
            self._secrets = (await store.secret("token-signing", lambda: secrets.token_urlsafe(48)),)

    def issue(self, session_id: str, vehicle_id: str, *, is_ego: bool) -> Token:
        """A token of a vehicle for a session."""
        return self._token(session_id, vehicle_id, is_ego, secrets.token_hex(16), int(self.clock()) + int(self._ttl_s))

    def renewed(self, record: SessionRecord, vehicle_id: str, before: str, key: str | None) -> Token:
        """A token of a vehicle in place of the one with the id ``before``. With a ``key``, `again` finds it again."""
        if key is None:
            return self.issue(record.session_id, vehicle_id, is_ego=vehicle_id == record.ego_id)
        expires = int(self.clock()) + int(self._ttl_s)
        token_id = _renewed_id(self._secrets[0], record.session_id, vehicle_id, before, key, expires)
        return self._token(record.session_id, vehicle_id, vehicle_id == record.ego_id, token_id, expires)

    def again(self, record: SessionRecord, vehicle_id: str, before: str, key: str | None) -> Token | None:
        """The vehicle's latest token, if it was made in place of the one with the id ``before`` and with this ``key``.

        Nothing of it is remembered: its id tells, to whoever has the secret. So it holds after a restart, and in
        another process. Whoever stole the token before does not have the key.
        """
        latest = record.token_ids.get(vehicle_id, "")
        expires = latest.partition("-")[0]
        if key is None or not expires.isdecimal():
            return None
        of = record.session_id, vehicle_id, before, key, int(expires)
        if not any(hmac.compare_digest(latest, _renewed_id(secret, *of)) for secret in self._secrets):
            return None
        return self._token(record.session_id, vehicle_id, vehicle_id == record.ego_id, latest, int(expires))

    def _token(self, session_id: str, vehicle_id: str, is_ego: bool, token_id: str, expires: int) -> Token:
        claims = {
            "iss": ISSUER,
            "aud": AUDIENCE,
            "sub": vehicle_id,
            "sid": session_id,
            "role": _role(is_ego),
            "jti": token_id,
            "iat": int(self.clock()),
            "exp": expires,
        }
        expires_at = datetime.fromtimestamp(expires, UTC).isoformat().replace("+00:00", "Z")
        return Token(jwt.encode(claims, self._secrets[0], ALGORITHM), token_id, expires_at)

    async def issue_all(self, session_id: str, vehicles: Iterable[str], ego_id: str) -> dict[str, Token]:
        """A token for each of some vehicles, made on another thread: those of a large team take milliseconds."""
        return await asyncio.to_thread(
            lambda: {vehicle: self.issue(session_id, vehicle, is_ego=vehicle == ego_id) for vehicle in vehicles}
        )

    def holder(self, record: SessionRecord, text: str | None, key: str | None = None) -> tuple[str, str]:
        """The vehicle that may speak in a session with this token, and the token's id.

        With the ``key`` with which it was renewed, the token before the vehicle's latest is one, too.

        Raises
        ------
        TokenRefused
            If it is none of this session, not the vehicle's latest, or expired.
        """
        claims = self._claims(text)
        if claims is None or claims["sid"] != record.session_id:
            raise TokenRefused("a bearer token of a vehicle of this session is needed")
        vehicle: str = claims["sub"]
        token_id: str = claims["jti"]
        counts = record.token_ids.get(vehicle) == token_id or self.again(record, vehicle, token_id, key) is not None
        if not counts or claims["role"] != _role(vehicle == record.ego_id):
            raise TokenRefused(RENEWED, vehicle)
        if claims["iat"] > self.clock() + LEEWAY_S:
            raise TokenRefused("the token is from the future: the gateways' clocks are too far apart", vehicle)
        if claims["exp"] <= self.clock() - LEEWAY_S:
            raise TokenRefused("the token has expired", vehicle, Kind.TOKEN_EXPIRED)
        return vehicle, token_id

    def signed(self, session_id: str, text: str) -> bool:
        """Whether this gateway made a token for a session. It may count no more: the session's record tells."""
        claims = self._claims(text)
        return claims is not None and claims["sid"] == session_id

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
                    options={"require": list(CLAIMS), "strict_aud": True, "verify_exp": False, "verify_iat": False},
                )
            except jwt.InvalidSignatureError:
                continue
            except (jwt.PyJWTError, ValueError, RecursionError):  # what is not a token at all may fail in any way
                return None
            return claims if isinstance(claims["exp"], int) and isinstance(claims["iat"], int) else None
        return None


class Claimed(NamedTuple):
    """What a token says of itself."""

    session_id: str
    vehicle_id: str
    token_id: str


def claimed(text: str) -> Claimed | None:
    """What a token says, true or not; None if it is no token at all. `Tokens.holder` finds out whether it is true."""
    parts = text.split(".") if len(text) <= TOKEN_BYTES else ()
    if len(parts) != 3:
        return None
    try:
        claims = json.loads(base64.urlsafe_b64decode(parts[1] + "=="))
    except (ValueError, RecursionError):
        return None
    if not isinstance(claims, dict):
        return None
    named = [claim for claim in (claims.get(name) for name in ("sid", "sub", "jti")) if isinstance(claim, str)]
    return Claimed(*named) if len(named) == len(Claimed._fields) else None


def _renewed_id(secret: str, session_id: str, vehicle_id: str, before: str, key: str, expires: int) -> str:
    named = json.dumps(["robosac renewed token", session_id, vehicle_id, before, key, expires]).encode()
    return f"{expires}-{hmac.new(secret.encode(), named, sha256).hexdigest()[:32]}"


def _role(is_ego: bool) -> str:
    return "ego" if is_ego else "teammate"
