"""Credentials as tests show and forge them."""

import base64

import jwt

KEY, OTHER_KEY = "key-number-one-0123", "key-number-two-4567"
SECRET, OTHER_SECRET = "s" * 32, "t" * 40
OPENING = {"ego_id": "a", "teammates": ["b"]}


def bearer(credential):
    return {} if credential is None else {"Authorization": f"Bearer {credential}"}


def claims_of(token):
    return jwt.decode(token, options={"verify_signature": False})


def forged(token, secret=SECRET, algorithm="HS256", headers=None, without=(), **changes):
    """A token that says the same but for the changes."""
    claims = {name: value for name, value in {**claims_of(token), **changes}.items() if name not in without}
    return jwt.encode(claims, secret, algorithm, headers)


def segment(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()
