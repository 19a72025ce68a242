"""Proofs that whoever shows a vehicle's token has the vehicle's key as well: DPoP (RFC 9449), with Ed25519.

A proof is a JWT of one's own for one request. It names the request's method and URL and the hash of the token, and is
signed with the key. A token that was stolen is then worth nothing where a proof is asked for.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import SplitResult, unquote, urlsplit

import jwt
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from jwt.algorithms import OKPAlgorithm

HEADER = "DPoP"
ALGORITHM = "EdDSA"
MAX_AGE_S = 60.0
"""How old a proof may be."""
LEEWAY_S = 10.0
"""How far the clocks of a vehicle and of gateways may be apart."""
PROOF_BYTES = 4096
"""A longer proof is not looked at."""
_TYPE = "dpop+jwt"
_CLAIMS = ("jti", "htm", "htu", "iat", "ath")
_ID_CHARACTERS = 256
_PORTS = {"http": 80, "https": 443}


class ProofError(ValueError):
    """A proof that proves nothing; the message says what is wrong with it."""


@dataclass(frozen=True)
class Call:
    """A request, as far as a proof is about it.

    Attributes
    ----------
    method : str
    path : str
        As the gateway sees it, percent-decoded.
    token : str
        What the request came with.
    """

    method: str
    path: str
    token: str


@dataclass(frozen=True)
class Proof:
    """What tells a proof from every other."""

    proof_id: str
    made_at: float
    """Unix time, seconds."""

    @property
    def ends_at(self) -> float:
        """From when on no gateway takes it any more whose clock is right to `LEEWAY_S`."""
        return self.made_at + MAX_AGE_S + 2 * LEEWAY_S


def make_proof(key: Ed25519PrivateKey, method: str, url: str, token: str, made_at: float | None = None) -> str:
    """A proof for one request, sent as the header ``DPoP``.

    Parameters
    ----------
    key : Ed25519PrivateKey
        The vehicle's.
    method : str
    url : str
        Where the request goes; its query is left out.
    token : str
        What the request comes with.
    made_at : float, optional
        Unix time, seconds; now by default.
    """
    parts = urlsplit(url)
    claims = {
        "jti": secrets.token_urlsafe(16),
        "htm": method,
        "htu": SplitResult(parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", "").geturl(),
        "iat": int(time.time() if made_at is None else made_at),
        "ath": _hash(token),
    }
    return jwt.encode(claims, key, ALGORITHM, {"typ": _TYPE, "jwk": _jwk(key.public_key())})


def check_proof(proof: str, key: Ed25519PublicKey, call: Call, now: float, public_url: str | None = None) -> Proof:
    """Check a proof by RFC 9449, section 4.3, but for whether it came before.

    Parameters
    ----------
    proof : str
    key : Ed25519PublicKey
        The one that the vehicle registered. The key that a proof names itself must be this one.
    call : Call
        The request that it came with.
    now : float
        Unix time, seconds.
    public_url : str, optional
        The gateway's address as its clients know it. By default a proof may name any host, and a path with anything
        before that of the request, as a proxy in front may have them.

    Raises
    ------
    ProofError
        If it does not prove that the key's owner makes this request now.
    """
    claims = _signed_claims(proof, key)
    proof_id, made_at = claims["jti"], claims["iat"]
    if not _is_id(proof_id):
        raise ProofError(f"jti must be a string of 1 to {_ID_CHARACTERS} printable ASCII characters")
    if claims["htm"] != call.method:
        raise ProofError(f"htm must be {call.method}, the request's method")
    _check_url(claims["htu"], call.path, public_url)
    if claims["ath"] != _hash(call.token):
        raise ProofError("ath must be the base64url SHA-256 of the token that the request came with")
    for name in ("iat", *(name for name in ("exp", "nbf") if name in claims)):
        if not _is_time(claims[name]):
            raise ProofError(f"{name} must be a number, Unix time in seconds")
    if claims.get("exp", now) <= now - LEEWAY_S:
        raise ProofError("exp is in the past by the gateway's clock")
    if claims.get("nbf", now) > now + LEEWAY_S:
        raise ProofError("nbf is in the future by the gateway's clock")
    if made_at < now - MAX_AGE_S - LEEWAY_S:
        raise ProofError(f"iat is more than {MAX_AGE_S:g} s ago by the gateway's clock")
    if made_at > now + LEEWAY_S:
        raise ProofError("iat is in the future by the gateway's clock")
    return Proof(proof_id, float(made_at))


def read_origin(url: str) -> tuple[str, str, int | None]:
    """Scheme, host and port of an http or https URL, in one form.

    Raises
    ------
    ValueError
        If it is none.
    """
    parts = urlsplit(url)
    scheme = parts.scheme.lower()
    if scheme not in _PORTS or not parts.hostname:
        raise ValueError("must be an http or https URL with a host")
    return scheme, parts.hostname, parts.port or _PORTS[scheme]


def _signed_claims(proof: str, key: Ed25519PublicKey) -> Mapping[str, Any]:
    if len(proof) > PROOF_BYTES:
        raise ProofError(f"it has more than {PROOF_BYTES} bytes")
    try:
        header = jwt.get_unverified_header(proof)
    except (jwt.PyJWTError, ValueError, RecursionError) as error:  # what is no JWT at all may fail in any way
        raise ProofError("it is not a JWT") from error
    if header.get("typ") != _TYPE:
        raise ProofError(f"typ must be {_TYPE}")
    if header.get("alg") != ALGORITHM:
        raise ProofError(f"alg must be {ALGORITHM}")
    named = header.get("jwk")
    if not isinstance(named, dict) or "d" in named:
        raise ProofError("jwk must be the vehicle's public key, and no private one")
    expected = _jwk(key)
    if {name: named.get(name) for name in expected} != expected:
        raise ProofError("jwk is not the key that the vehicle registered")
    options: Any = {"require": list(_CLAIMS)} | dict.fromkeys(
        ("verify_exp", "verify_nbf", "verify_iat", "verify_aud", "verify_iss", "verify_sub", "verify_jti"), False
    )
    try:
        claims: Mapping[str, Any] = jwt.decode(proof, key, algorithms=[ALGORITHM], options=options)
    except jwt.InvalidSignatureError as error:
        raise ProofError("its signature is not by the key that the vehicle registered") from error
    except jwt.MissingRequiredClaimError as error:
        raise ProofError(f"{error.claim} is missing") from error
    except (jwt.PyJWTError, ValueError, RecursionError) as error:
        raise ProofError("it is not a JWT with claims") from error
    return claims


def _is_time(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value  # noqa: PLR0124 (NaN)


def _is_id(value: object) -> bool:
    """Whether it can be kept as an id: half a character, or one that ends texts elsewhere, is taken by no database."""
    return isinstance(value, str) and 0 < len(value) <= _ID_CHARACTERS and value.isascii() and value.isprintable()


def _check_url(named: object, path: str, public_url: str | None) -> None:
    """Check that a proof is for the request's URL, whatever the query."""
    try:
        if not isinstance(named, str):
            raise ValueError("must be a string")
        origin, named_path = read_origin(named), unquote(urlsplit(named).path)
    except ValueError as error:
        raise ProofError("htu must be the request's URL") from error
    if public_url is None:
        if not named_path.endswith(path):
            raise ProofError(f"htu must be the request's URL, whose path ends with {path}")
    elif origin != read_origin(public_url) or named_path != unquote(urlsplit(public_url).path).rstrip("/") + path:
        raise ProofError(f"htu must be {public_url.rstrip('/')}{path}")


def _jwk(key: Ed25519PublicKey) -> dict[str, Any]:
    return OKPAlgorithm.to_jwk(key, as_dict=True)


def _hash(token: str) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(token.encode()).digest()).rstrip(b"=").decode()
