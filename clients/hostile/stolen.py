"""Tokens of vehicles that registered keys, in the hands of somebody without the keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from clients.client import MSGPACK
from clients.hostile.attacker import BROKEN, Attacker, as_json, message_of
from robosac import wire
from robosac.possession import HEADER, make_proof
from robosac.signatures import show_public_key, sign

EGO, MATE = "ego", "mate"
FEW = 4
Attempt = tuple[str, str, str, dict[str, Any]]
"""Method, path, whose token, and options of the request."""


async def tokens(attacker: Attacker) -> None:
    """Try all that a vehicle may do with its token, without its key: with no proof, one by another key, or one that
    was made for another request.
    """
    keys = {name: Ed25519PrivateKey.generate() for name in (EGO, MATE)}
    public = {name: show_public_key(key) for name, key in keys.items()}
    opened = await attacker.open([MATE], public_keys=public)
    stolen = {EGO: opened["ego_token"], MATE: opened["teammate_tokens"][MATE]}
    path = f"/v1/sessions/{opened['session_id']}"

    async def one() -> None:
        for method, where, whose, options in _attempts(attacker, opened["session_id"], stolen, keys):
            answer = await attacker.ask(method, path + where, stolen[whose], **options)
            if answer.is_success:
                attacker.answers[f"{BROKEN}{method} {where or '/'} by the token of {whose}"] += 1
        if await _team(attacker, path, stolen[EGO]) != [MATE]:
            attacker.answers[f"{BROKEN}another team"] += 1

    await attacker.again_and_again(FEW, one)


async def _team(attacker: Attacker, path: str, token: str) -> list[str]:
    state = (await attacker.ask("GET", path, token)).json()
    return list(state.get("teammates", ()))


def _attempts(
    attacker: Attacker, session_id: str, stolen: dict[str, str], keys: dict[str, Ed25519PrivateKey]
) -> Iterator[Attempt]:
    own = Ed25519PrivateKey.generate()
    changes: list[Attempt] = [
        ("POST", "/token", EGO, {}),
        ("POST", "/token", MATE, {}),
        ("POST", "/teammates", EGO, as_json({"teammates": ["friend"]})),
        ("DELETE", f"/teammates/{MATE}", EGO, {}),
        ("DELETE", "", EGO, {}),
    ]
    for method, where, whose, options in changes:
        url = str(attacker.http.base_url.join(f"/v1/sessions/{session_id}{where}"))
        elsewhere = make_proof(keys[whose], "GET", url, stolen[whose])  # as somebody may have seen it on its way
        for proof in (None, make_proof(own, method, url, stolen[whose]), elsewhere):
            proven = {} if proof is None else {HEADER: proof}
            yield method, where, whose, {**options, "headers": {**options.get("headers", {}), **proven}}
    frame = attacker.frame
    spoken = message_of(frame["ego"])
    for whose, where in ((EGO, "/messages"), (MATE, "/messages"), (EGO, "/frames")):
        digest = wire.content_digest(0, whose, spoken)
        for signature in (None, sign(own, session_id, whose, 0, digest)):
            if where == "/frames":
                body = wire.pack_frame(0, spoken, {}, signature)
            else:
                body = wire.pack_message(0, whose, spoken, signature)
            yield "POST", where, whose, {"content": body, "headers": {"Content-Type": MSGPACK}}
