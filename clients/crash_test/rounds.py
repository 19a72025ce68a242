"""Gateways on one database that are killed round by round."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import GatewayClient
from clients.crash_test import sqlite
from clients.crash_test.driven import Driven
from clients.errors import GatewayError, GatewayUnavailable, GatewayUnreachable
from clients.load_test import DEFENSE, EGO, REFUSED_WAIT_S, TEAM, Bodies
from clients.local_gateway import GatewayProcess

DEFENSES: Sequence[Mapping[str, Any]] = (
    DEFENSE,
    DEFENSE | {"kind": "static_team"},
    {"kind": "a2cp"},
    {"kind": "group_testing"},
    {"kind": "none"},
)
"""The sessions get these, one after another."""
LOADED_S = (0.05, 1.2)
"""How long the gateways are loaded before what happens next, at random."""
BUDGET_MS = 5000.0
"""Long enough that no frame is cut short on a busy machine."""


class Incident(StrEnum):
    """What happens while the gateways are loaded, before all are killed."""

    KILL = "kill"
    """Nothing else."""
    BACKUP = "backup"
    """Another process reads the database and backs it up (SQLite only)."""
    PAIR = "pair"
    """Two gateways share the database; one of them is terminated and started again, then the other is killed and
    started again. Egos go to the one that is there."""


def possible(database_url: str) -> list[Incident]:
    """What can happen on a database, in turn."""
    is_file = sqlite.path_of(database_url) is not None
    return [incident for incident in Incident if is_file or incident is not Incident.BACKUP]


@dataclass
class Kill:
    """What one round showed."""

    incident: Incident
    loaded_s: float = 0.0
    """From the start of the load to the kill."""
    acknowledged: int = 0
    """Frames acknowledged since the kill before."""
    unacknowledged: int = 0
    """Frames that were decided, but whose answer was lost with the gateway."""
    refused: int = 0
    """Frames that a gateway could not serve just then (503)."""
    restart_s: float = 0.0
    """From the start of the process to its readiness."""
    first_answer_s: float = 0.0
    """From the start of the process until every session had been checked and had its next frame answered."""
    wrong: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Running:
    process: GatewayProcess
    client: GatewayClient


class Rounds:
    """Kills gateways one after another on one database.

    Parameters
    ----------
    database_url : str
    log : Path
        Takes what the gateways print.
    bodies : Bodies
    rng : numpy.random.Generator
        Of the moments.
    """

    def __init__(self, database_url: str, log: Path, bodies: Bodies, rng: np.random.Generator) -> None:
        self._database_url = database_url
        self._file = sqlite.path_of(database_url)
        self._log = log
        self._bodies = bodies
        self._rng = rng
        self._up: list[_Running] = []
        self.sessions: list[Driven] = []

    async def open(self, sessions: int) -> None:
        """Start the first gateway and open sessions, with one defence after another."""
        await self._start()
        for number in range(sessions):
            defense = DEFENSES[number % len(DEFENSES)]
            process, client = self._up[0].process, self._up[0].client
            async with process.watched():
                opened = await client.open_session(EGO, TEAM, defense=defense, latency_budget_ms=BUDGET_MS)
            self.sessions.append(Driven(defense["kind"], opened))

    async def play(self, incident: Incident) -> Kill:
        """Load the gateways through an incident, kill them, start one and check every session."""
        kill = Kill(incident)
        answered = sum(session.answered for session in self.sessions)
        if incident is Incident.PAIR:
            await self._start()
        began = time.perf_counter()
        loads = [asyncio.create_task(self._drive(number, kill)) for number in range(len(self.sessions))]
        await self._some_time()
        if incident is Incident.BACKUP and self._file is not None:
            kill.wrong += await asyncio.to_thread(
                sqlite.read_and_back_up, self._file, self._file.with_name(f"{self._file.name}.backup")
            )
            await self._some_time()
        if incident is Incident.PAIR:
            for gently in (True, False):
                await self._stop(self._up[0], gently=gently)
                await self._start()
                await self._some_time()
        kill.loaded_s = time.perf_counter() - began
        await self.stop()
        await asyncio.gather(*loads)
        kill.acknowledged = sum(len(session.acknowledged) for session in self.sessions)
        started = time.perf_counter()
        await self._start()
        kill.restart_s = time.perf_counter() - started
        for number, session in enumerate(self.sessions):
            try:
                async with self._up[0].process.watched():
                    complaints = await session.check(self._up[0].client, self._bodies)
            except GatewayError as error:
                complaints = [f"it could not be checked: {error}"]
            kill.wrong += [f"session {number} ({session.defense}): {complaint}" for complaint in complaints]
        kill.first_answer_s = time.perf_counter() - started
        kill.unacknowledged = sum(session.answered for session in self.sessions) - answered - kill.acknowledged
        if self._file is not None:
            kill.wrong += await asyncio.to_thread(sqlite.integrity, self._file)
        return kill

    async def stop(self) -> None:
        """Kill all gateways at once."""
        await asyncio.gather(*(gateway.process.kill() for gateway in self._up))
        while self._up:
            await self._up.pop().client.aclose()

    async def _drive(self, number: int, kill: Kill) -> None:
        """Post frames of a session, to one gateway or another, until none is left."""
        session = self.sessions[number]
        while self._up:
            gateway = self._up[number % len(self._up)]
            try:
                await session.post(session.ego(gateway.client), self._bodies)
            except GatewayUnreachable:
                await asyncio.sleep(REFUSED_WAIT_S)
            except GatewayUnavailable:
                kill.refused += 1
                await asyncio.sleep(REFUSED_WAIT_S)

    async def _some_time(self) -> None:
        await asyncio.sleep(float(self._rng.uniform(*LOADED_S)))

    async def _start(self) -> None:
        process = GatewayProcess(self._log, self._database_url)
        try:
            await process.ready()
        except BaseException:
            await process.kill()
            raise
        self._up.append(_Running(process, GatewayClient(process.url)))

    async def _stop(self, gateway: _Running, *, gently: bool) -> None:
        if not gently:
            await gateway.process.kill()
        elif not await gateway.process.stop():
            raise GatewayUnreachable("a gateway did not end on SIGTERM")
        self._up.remove(gateway)
        await gateway.client.aclose()
