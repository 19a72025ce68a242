"""Signatures of vehicles over their messages: Ed25519 (RFC 8032) over the content's digest.

What is signed names the session and the purpose, so that a signature is worth nothing anywhere else.
"""

from __future__ import annotations

import base64
import binascii

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_BYTES = 64
_PURPOSE = b"robosac message v1"


def read_public_key(text: str) -> Ed25519PublicKey:
    """A vehicle's public key from its base64 form (32 bytes).

    Raises
    ------
    ValueError
        If it is not one.
    """
    try:
        return Ed25519PublicKey.from_public_bytes(base64.b64decode(text, validate=True))
    except (binascii.Error, ValueError) as error:
        raise ValueError("must be an Ed25519 public key, 32 bytes in base64") from error


def show_public_key(key: Ed25519PrivateKey) -> str:
    """The base64 form of the public half of a key."""
    return base64.b64encode(key.public_key().public_bytes_raw()).decode()


def sign(key: Ed25519PrivateKey, session_id: str, content_digest: str) -> bytes:
    """Sign a message.

    Parameters
    ----------
    key : Ed25519PrivateKey
    session_id : str
        The session that the message is for.
    content_digest : str
        Of `robosac.wire.content_digest`.

    Returns
    -------
    bytes
        64 of them.
    """
    return key.sign(_signed(session_id, content_digest))


def is_valid(key: Ed25519PublicKey, session_id: str, content_digest: str, signature: bytes) -> bool:
    """Whether a signature is that of the key's owner over this message for this session."""
    try:
        key.verify(signature, _signed(session_id, content_digest))
    except InvalidSignature:
        return False
    return True


def _signed(session_id: str, content_digest: str) -> bytes:
    return b"\n".join((_PURPOSE, session_id.encode(), content_digest.encode()))
