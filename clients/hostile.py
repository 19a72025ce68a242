"""Attacks on a gateway by somebody who has a key: each is bounded in time and in number, and says what it was answered.

They run in a process of their own, so that the honest ego's clock does not wait for them.
"""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum

import httpx
import msgpack
import numpy as np

from clients.client import MSGPACK
from clients.raw_http import connected, post_head, read_response
from robosac import wire

IDLE_SESSIONS = 9
SESSIONS = 10
CONNECTIONS = 24
HEADS = 240
STRANGERS = 12
LOCKED = 0.5
"""Part of the time for which the database is locked; the rest shows how the gateway recovers."""
LONG = {"kind": "sample_consensus", "attacker_ratio": 0.5, "sampling_budget": 600, "collaborators": 5}
REFUSED_WAIT_S = 0.05


class Attack(StrEnum):
    """What an attacker does."""

    IDLE = "idle gathers"
    """Nine sessions wait for teammates that never send."""
    LONG = "long budgets"
    """One session asks for 600 hypotheses within 60 s."""
    MANY = "many sessions"
    """Ten sessions of one key do so at once, one frame after the other."""
    BODIES = "body flood"
    """Bodies as large as allowed that are no messages, with a good token, some sent very slowly."""
    HEADS = "heads without end"
    """Heads of requests that never end, most of them sent very slowly."""
    DATABASE = "locked database"
    """Another process holds the database's write lock."""


@dataclass(frozen=True)
class Target:
    """A gateway to attack, and what for."""

    url: str
    key: str
    database: str
    strange: bytes
    """A whole frame of teammates with nothing in common with the ego (`strange_frame`)."""
    frame: bytes
    """An honest whole frame."""


def strange_frame(body: bytes) -> bytes:
    """A whole frame, from an honest one, whose teammates all contradict the ego.

    Their maps are those of an honest teammate with the channels in another order: no larger than honest ones are, and
    no two alike.
    """
    frame, rng = msgpack.unpackb(body), np.random.default_rng(0)
    honest = next(iter(frame["teammates"].values()))
    teammates = {}
    for number in range(STRANGERS):
        tensors = {}
        for name, tensor in honest["tensors"].items():
            values = np.frombuffer(tensor["data"], tensor["dtype"]).reshape(tensor["shape"])
            tensors[name] = {**tensor, "data": rng.permutation(values).tobytes()}
        teammates[f"stranger-{number}"] = {**honest, "tensors": tensors}
    return wire.pack({**frame, "teammates": teammates})


def run_attack(attack: Attack, target: Target, seconds: float) -> Counter[str]:
    """Attack for a time; what was answered, by status."""
    if attack is Attack.DATABASE:
        return _lock(target, LOCKED * seconds)
    return asyncio.run(_attack(attack, target, seconds))


async def _attack(attack: Attack, target: Target, seconds: float) -> Counter[str]:
    answers: Counter[str] = Counter()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=target.url, timeout=seconds + 30.0, limits=limits) as http:
        attacker = _Attacker(http, target, answers)
        work = {
            Attack.IDLE: attacker.idle,
            Attack.LONG: lambda: attacker.long(1),
            Attack.MANY: lambda: attacker.long(SESSIONS),
            Attack.BODIES: attacker.flood,
            Attack.HEADS: attacker.heads,
        }[attack]
        try:
            async with asyncio.timeout(seconds):
                await work()
        except TimeoutError:
            pass
    return answers


@dataclass
class _Attacker:
    """Somebody with a key."""

    http: httpx.AsyncClient
    target: Target
    answers: Counter[str]

    async def idle(self) -> None:
        """Let egos wait for teammates that never send."""
        frame = msgpack.unpackb(self.target.frame)
        message = wire.pack({"frame": 0, "vehicle_id": "ego", **frame["ego"]})
        options = {"latency_budget_ms": 60_000, "gather_ms": 60_000}
        sessions = [await self._open(list(frame["teammates"]), **options) for _ in range(IDLE_SESSIONS)]
        await asyncio.gather(*(self._post(sid, "messages", token, message) for sid, token in sessions))

    async def long(self, number: int) -> None:
        """Let sessions ask for as many hypotheses as there are, one frame after the other."""
        team = list(msgpack.unpackb(self.target.strange)["teammates"])
        options = {"latency_budget_ms": 60_000, "defense": LONG}
        await asyncio.gather(*[self._long(await self._open(team, **options)) for _ in range(number)])

    async def flood(self) -> None:
        """Send large bodies that are no messages, each connection again and again; every third sends slowly."""
        team = list(msgpack.unpackb(self.target.frame)["teammates"])
        sid, token = await self._open(team)
        await asyncio.gather(*(self._flood(sid, token, slowly=k % 3 == 0) for k in range(CONNECTIONS)))

    async def heads(self) -> None:
        """Send heads that never end, each connection again and again; most of them slowly."""
        await asyncio.gather(*(self._head(slowly=k % 12 > 0) for k in range(HEADS)))

    async def _long(self, session: tuple[str, str]) -> None:
        fields = msgpack.unpackb(self.target.strange)
        sid, token = session
        number = 0
        while True:
            status = await self._post(sid, "frames", token, wire.pack({**fields, "frame": number}))
            number += 1
            if status != 200:
                await asyncio.sleep(REFUSED_WAIT_S)

    async def _flood(self, sid: str, token: str, *, slowly: bool) -> None:
        size = len(self.target.frame)
        head = post_head(self.target.url, f"/v1/sessions/{sid}/frames", size, token, Connection="close")
        while True:
            try:
                async with connected(self.target.url) as (reader, writer):
                    writer.write(head)
                    if slowly:
                        writer.write(bytes(size // 2))
                        await asyncio.sleep(1.0)
                        writer.write(bytes(size - size // 2))
                    else:
                        writer.write(bytes(size))
                    status, _ = await read_response(reader)
                    self.answers[str(status)] += 1
            except (OSError, asyncio.IncompleteReadError, ValueError) as error:
                self.answers[type(error).__name__] += 1
            await asyncio.sleep(REFUSED_WAIT_S)

    async def _head(self, *, slowly: bool) -> None:
        while True:
            try:
                async with connected(self.target.url) as (reader, writer):
                    writer.write(b"GET /healthz HTTP/1.1\r\nlong: ")
                    line = await _while_dripping(reader, writer, slowly=slowly)
                    self.answers[line.split(b" ")[1].decode() if line else "hung up"] += 1
            except OSError as error:
                self.answers[type(error).__name__] += 1
            await asyncio.sleep(REFUSED_WAIT_S)

    async def _open(self, team: list[str], **options: object) -> tuple[str, str]:
        body = {"ego_id": "ego", "teammates": team, **options}
        headers = {"Authorization": f"Bearer {self.target.key}"}
        response = await self.http.post("/v1/sessions", json=body, headers=headers)
        response.raise_for_status()
        opened = response.json()
        return opened["session_id"], opened["ego_token"]

    async def _post(self, sid: str, what: str, token: str, body: bytes) -> int:
        headers = {"Authorization": f"Bearer {token}", "Content-Type": MSGPACK}
        response = await self.http.post(f"/v1/sessions/{sid}/{what}", content=body, headers=headers)
        self.answers[str(response.status_code)] += 1
        return response.status_code


async def _while_dripping(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, slowly: bool) -> bytes:
    """The first line of what a server answers while it is sent more and more; empty if it hangs up."""
    answer = asyncio.ensure_future(reader.readline())
    try:
        while not answer.done():
            writer.write(b"x" if slowly else b"x" * 2**16)
            await writer.drain()
            await asyncio.wait([answer], timeout=REFUSED_WAIT_S)
        return await answer
    finally:
        answer.cancel()
        await asyncio.gather(answer, return_exceptions=True)


def _lock(target: Target, seconds: float) -> Counter[str]:
    """Hold the lock with which the gateway would write."""
    with closing(sqlite3.connect(target.database, isolation_level=None, timeout=10.0)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        time.sleep(seconds)
        connection.execute("ROLLBACK")
    return Counter()
