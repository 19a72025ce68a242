"""Sessions that ask for much."""

from __future__ import annotations

import asyncio
import itertools

import msgpack
import numpy as np

from clients.client import MSGPACK
from clients.hostile.attacker import PAUSE_S, Attacker, bearer, message_of
from robosac import wire
from robosac.detectors import Message

IDLE_SESSIONS = 9
SESSIONS = 10
LARGE_TEAMS, TEAMMATES = 4, 63
FEW = 8
FAR_AHEAD = 10**9
LONG_ACCEPT = "," * 31_000
LONG = {"kind": "sample_consensus", "attacker_ratio": 0.5, "sampling_budget": 600, "collaborators": 5}


async def idle(attacker: Attacker) -> None:
    """Let egos wait for teammates that never send."""
    message = wire.pack({"frame": 0, "vehicle_id": "ego", **attacker.frame["ego"]})
    options = {"latency_budget_ms": 60_000, "gather_ms": 60_000}
    opened = [await attacker.open(attacker.frame["teammates"], **options) for _ in range(IDLE_SESSIONS)]
    await asyncio.gather(*(attacker.post(one["session_id"], "messages", one["ego_token"], message) for one in opened))


async def long(attacker: Attacker, number: int) -> None:
    """Let sessions ask for as many hypotheses as there are, one frame after the other."""
    fields = msgpack.unpackb(attacker.target.strange)
    options = {"latency_budget_ms": 60_000, "defense": LONG}
    await _frames(attacker, fields, number, options)


async def large_teams(attacker: Attacker) -> None:
    """Let sessions of as many teammates as are allowed send whole frames of the default defence."""
    strangers = list(msgpack.unpackb(attacker.target.strange)["teammates"].values())
    teammates = {f"t{number}": strangers[number % len(strangers)] for number in range(TEAMMATES)}
    fields = {**attacker.frame, "teammates": teammates}
    await _frames(attacker, fields, LARGE_TEAMS, {"latency_budget_ms": 60_000})


async def stale(attacker: Attacker) -> None:
    """Send frames again that are answered: small, as they are compressed, and long to look through."""
    team = [f"mate-{number}" for number in range(TEAMMATES)]
    opened = [await attacker.open(team, latency_budget_ms=60_000) for _ in range(FEW)]
    message, packing = _nothing(attacker), wire.Packing("int8", compress=True)
    earlier, later = (wire.pack_frame(k, message, dict.fromkeys(team, message), packing=packing) for k in range(2))
    for session in opened:
        await attacker.post(session["session_id"], "frames", session["ego_token"], later)

    async def one() -> None:
        session = opened.pop()
        try:
            await attacker.post(session["session_id"], "frames", session["ego_token"], earlier)
        finally:
            opened.append(session)

    await attacker.again_and_again(FEW, one)


async def long_accepts(attacker: Attacker) -> None:
    """Send good messages, with a header that is a list of thousands."""
    opened = [await attacker.as_teammate() for _ in range(FEW)]
    frames = itertools.count(FAR_AHEAD, -1)  # earlier ones take the place of later ones
    message, packing = _nothing(attacker), wire.Packing("int8", compress=True)

    async def one() -> None:
        session_id, name, token = mate = opened.pop()
        try:
            headers = {"Accept": LONG_ACCEPT, "Content-Type": MSGPACK} | bearer(token)
            body = wire.pack_message(next(frames), name, message, packing=packing)
            await attacker.ask("POST", f"/v1/sessions/{session_id}/messages", content=body, headers=headers)
        finally:
            opened.append(mate)

    await attacker.again_and_again(FEW, one)


def _nothing(attacker: Attacker) -> Message:
    """A message in which there is nothing, as the honest ego sends them."""
    honest = message_of(attacker.frame["ego"])
    return Message(honest.pose, {name: np.zeros_like(each) for name, each in honest.tensors.items()})


async def _frames(attacker: Attacker, fields: dict[str, object], number: int, options: dict[str, object]) -> None:
    async def one(sid: str, token: str) -> None:
        frame = 0
        while True:
            status = await attacker.post(sid, "frames", token, wire.pack({**fields, "frame": frame}))
            frame += 1
            if status != 200:
                await asyncio.sleep(PAUSE_S)

    team = list(fields["teammates"])  # type: ignore[call-overload]
    opened = [await attacker.open(team, **options) for _ in range(number)]
    await asyncio.gather(*(one(session["session_id"], session["ego_token"]) for session in opened))
