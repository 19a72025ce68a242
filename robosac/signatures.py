"""Signatures of vehicles over their messages, and of the gateway over the ends of its logs: Ed25519 (RFC 8032).

What is signed are lines: the purpose with its version, then each field with its name (``session=``, ``vehicle=``,
``frame=`` and ``digest=``, or ``session=``, ``seq=`` and ``head=``). So a signature is worth nothing anywhere else.
"""

from __future__ import annotations

import base64
import binascii
import hashlib

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_BYTES = 64
_PURPOSE = "robosac message v2"
_HEAD_PURPOSE = "robosac audit head v1"
_P = 2**255 - 19
_SMALL_ORDER_Y = frozenset({
    0, 1, _P - 1,
    int.from_bytes(bytes.fromhex("26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05"), "little"),
    int.from_bytes(bytes.fromhex("c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a"), "little"),
})  # fmt: skip
"""Of the eight points of small order (libsodium, ``ge25519_has_small_order``)."""


def read_public_key(text: str) -> Ed25519PublicKey:
    """A vehicle's public key from its base64 form (32 bytes).

    Points of small order are refused: under such a key some signatures are valid for any message.

    Raises
    ------
    ValueError
        If it is not one.
    """
    try:
        raw = base64.b64decode(text, validate=True)
        key = Ed25519PublicKey.from_public_bytes(raw)
    except (binascii.Error, ValueError) as error:
        raise ValueError("must be an Ed25519 public key, 32 bytes in base64") from error
    y = int.from_bytes(raw, "little") & (2**255 - 1)
    if y % _P in _SMALL_ORDER_Y or y >= _P:
        raise ValueError("must not be a point of small order, nor written in another form than the usual")
    return key


def show_public_key(key: Ed25519PrivateKey) -> str:
    """The base64 form of the public half of a key."""
    return base64.b64encode(key.public_key().public_bytes_raw()).decode()


def sign(key: Ed25519PrivateKey, session_id: str, vehicle_id: str, frame: int, content_digest: str) -> bytes:
    """Sign a message.

    Parameters
    ----------
    key : Ed25519PrivateKey
    session_id : str
        The session that the message is for.
    vehicle_id : str
        Who says it.
    frame : int
        What frame it is for.
    content_digest : str
        Of `robosac.wire.content_digest`.

    Returns
    -------
    bytes
        64 of them.
    """
    return key.sign(_signed(session_id, vehicle_id, frame, content_digest))


def is_valid(
    key: Ed25519PublicKey, session_id: str, vehicle_id: str, frame: int, content_digest: str, signature: bytes
) -> bool:
    """Whether a signature is that of the key's owner over this message of this vehicle, for this frame and session."""
    return _verifies(key, signature, _signed(session_id, vehicle_id, frame, content_digest))


def key_id(key: Ed25519PublicKey) -> str:
    """A short name of a key: 16 hexadecimal digits of the SHA-256 of its bytes."""
    return hashlib.sha256(key.public_bytes_raw()).hexdigest()[:16]


def sign_head(key: Ed25519PrivateKey, session_id: str, seq: int, head: str) -> bytes:
    """A gateway's signature over the end of a session's audit log: ``head`` is the digest of the record ``seq``."""
    return key.sign(_signed_head(session_id, seq, head))


def is_valid_head(key: Ed25519PublicKey, session_id: str, seq: int, head: str, signature: bytes) -> bool:
    """Whether a signature is one of `sign_head` by the key's owner over this."""
    return _verifies(key, signature, _signed_head(session_id, seq, head))


def _verifies(key: Ed25519PublicKey, signature: bytes, signed: bytes) -> bool:
    try:
        key.verify(signature, signed)
    except InvalidSignature:
        return False
    return True


def _signed(session_id: str, vehicle_id: str, frame: int, content_digest: str) -> bytes:
    named = (f"session={session_id}", f"vehicle={vehicle_id}", f"frame={frame}", f"digest={content_digest}")
    return "\n".join((_PURPOSE, *named)).encode()


def _signed_head(session_id: str, seq: int, head: str) -> bytes:
    return "\n".join((_HEAD_PURPOSE, f"session={session_id}", f"seq={seq}", f"head={head}")).encode()
