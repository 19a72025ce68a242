"""Requests that are answered soon, one after the other and many at a time."""

from __future__ import annotations

import base64

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from clients.hostile.attacker import Attacker, as_json

AT_A_TIME = 24
FEW = 8
RECORDS = 200
LARGE_BYTES = 250_000


async def small_messages(attacker: Attacker) -> None:
    """Messages that are none."""
    session_id, _, token = await attacker.as_teammate()
    bodies = [b"\xc1", b"\x80", b"{}", b"\x83" * 64]

    async def one() -> None:
        for body in bodies:
            await attacker.post(session_id, "messages", token, body)

    await attacker.again_and_again(AT_A_TIME, one)


async def strangers(attacker: Attacker) -> None:
    """Messages and frames of nobody."""

    async def one() -> None:
        for session_id in (attacker.target.session_id, "0" * 32):
            for what in ("messages", "frames"):
                await attacker.post(session_id, what, "x" * 40, b"x")

    await attacker.again_and_again(AT_A_TIME, one)


async def opening(attacker: Attacker) -> None:
    """Sessions, opened and closed."""

    async def one() -> None:
        opened = await attacker.open(["mate"])
        await attacker.ask("DELETE", f"/v1/sessions/{opened['session_id']}", opened["ego_token"])

    await attacker.again_and_again(AT_A_TIME, one)


async def large_openings(attacker: Attacker) -> None:
    """Requests for sessions with a thousand names that are none."""
    name = "\x01" * 30
    body = as_json({"ego_id": "ego", "teammates": [f"{name}{k}" for k in range(LARGE_BYTES // 200)]})

    async def one() -> None:
        await attacker.ask("POST", "/v1/sessions", attacker.target.key, **body)

    await attacker.again_and_again(AT_A_TIME, one)


async def joining(attacker: Attacker) -> None:
    """A teammate with a key of its own, who joins and leaves."""
    key = Ed25519PrivateKey.generate().public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    public = base64.b64encode(key).decode()
    sessions = [await attacker.open(["mate"]) for _ in range(FEW)]

    async def one() -> None:
        session = sessions.pop()
        path, token = f"/v1/sessions/{session['session_id']}/teammates", session["ego_token"]
        try:
            body = as_json({"teammates": ["friend"], "public_keys": {"friend": public}})
            await attacker.ask("POST", path, token, **body)
            await attacker.ask("DELETE", f"{path}/friend", token)
        finally:
            sessions.append(session)

    await attacker.again_and_again(FEW, one)


async def tokens(attacker: Attacker) -> None:
    """One token after the other."""
    mates = [await attacker.as_teammate() for _ in range(FEW)]

    async def one() -> None:
        session_id, name, token = mates.pop()
        try:
            answer = await attacker.ask("POST", f"/v1/sessions/{session_id}/token", token)
            token = answer.json().get("token", token)
        finally:
            mates.append((session_id, name, token))

    await attacker.again_and_again(FEW, one)


async def audit(attacker: Attacker) -> None:
    """A log of some length."""
    session = await attacker.open(["mate"])
    path, token = f"/v1/sessions/{session['session_id']}", session["ego_token"]
    for number in range(RECORDS // 2):
        await attacker.ask("POST", f"{path}/teammates", token, **as_json({"teammates": [f"friend-{number}"]}))
        await attacker.ask("DELETE", f"{path}/teammates/friend-{number}", token)

    async def one() -> None:
        await attacker.ask("GET", f"{path}/audit", token)

    await attacker.again_and_again(AT_A_TIME, one)


async def metrics(attacker: Attacker) -> None:
    """What is counted, and whether the gateway is ready."""

    async def one() -> None:
        await attacker.ask("GET", "/metrics")
        await attacker.ask("GET", "/readyz")

    await attacker.again_and_again(AT_A_TIME, one)


async def pages(attacker: Attacker) -> None:
    """What the API is like."""

    async def one() -> None:
        await attacker.ask("GET", "/openapi.json")
        await attacker.ask("GET", "/docs")

    await attacker.again_and_again(AT_A_TIME, one)
