"""Sessions that ask for much."""

from __future__ import annotations

import asyncio

import msgpack

from clients.hostile.attacker import PAUSE_S, Attacker
from robosac import wire

IDLE_SESSIONS = 9
SESSIONS = 10
LARGE_TEAMS, TEAMMATES = 4, 63
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
