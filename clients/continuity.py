"""Whether sessions go on while gateway processes end and begin: vehicles that speak for themselves, phase by phase.

Every vehicle posts its own message, as on a road, and teammates stand by. What came of each frame is counted by the
phase in which it was asked for. At the end each session's log is followed from its first line: the chain holds, every
answer is in it as it was acknowledged, and it tells which process decided what.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from clients.client import GatewayClient, VehicleClient
from clients.crash_test.driven import Driven
from clients.errors import FrameConflict, GatewayError, GatewayUnavailable, GatewayUnreachable
from clients.load_test import EGO, TEAM, Bodies
from clients.simulation import Fleet
from robosac import wire
from robosac.answers import FrameAnswer
from robosac.attacks import PGD
from robosac.detectors import load
from robosac.scenes import IntersectionScene

REFUSED_WAIT_S = 0.05
"""How long a vehicle waits after it was refused."""


@dataclass
class Phase:
    """What came of the frames that were asked for while something happened."""

    name: str
    asked: int = 0
    answered: int = 0
    tested: int = 0
    """Answered with a subset of teammates that was tested in the frame, or found in conflict."""
    whole: int = 0
    """Answered from the messages of all teammates."""
    in_time: int = 0
    """Answered within the budget, as the client saw it."""
    untold: int = 0
    """Frames that lacked a message without saying that the session had moved, though all had been sent."""
    sent_again: int = 0
    longest_gap_s: float = 0.0
    """From an answer to the next of the same session."""
    longest_wait_s: float = 0.0
    """From the first frame that a session asks for after an answer to its next answer, to that frame or a later one."""
    refused: Counter[str] = field(default_factory=Counter)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; shares are of the frames asked for."""
        shares = {f"{name}_share": getattr(self, name) / max(self.asked, 1) for name in ("tested", "whole", "in_time")}
        return {**vars(self), "refused": dict(self.refused), **shares}


def prepare(frames: int, attacked: bool = False) -> Mapping[str, Bodies]:
    """Packed messages of one fleet by vehicle."""
    fleet = Fleet(IntersectionScene(3), load(), 1, int(attacked), PGD(), seed=0)
    sensed = [fleet.sense(index)[0] for index in range(frames)]
    packed = {name: Bodies([wire.pack_message(0, name, one.sent[name]) for one in sensed]) for name in TEAM}
    return {**packed, EGO: Bodies([wire.pack_message(0, EGO, one.message) for one in sensed])}


class Traffic:
    """Sessions that are driven at a rate.

    Parameters
    ----------
    connect : callable
        Makes a client; every session has its own, as its vehicles have connections of their own.
    bodies : mapping of vehicle to Bodies
    rate_hz : float
        Frames a second of each session.
    budget_ms : float
    """

    def __init__(
        self, connect: Callable[[], GatewayClient], bodies: Mapping[str, Bodies], rate_hz: float, budget_ms: float
    ) -> None:
        self._connect = connect
        self._bodies = bodies
        self._rate_hz = rate_hz
        self._budget_ms = budget_ms
        self._driving: list[asyncio.Task[None]] = []
        self._over = False
        self.sessions: list[Driven] = []
        self.phase = Phase("start")
        self.phases: list[Phase] = []

    async def open(self, sessions: int, defense: Mapping[str, Any]) -> None:
        """Open sessions and begin to drive them, one after another within a period."""
        async with self._connect() as gateway:
            for _ in range(sessions):
                opened = await gateway.open_session(
                    EGO, TEAM, defense=defense, latency_budget_ms=self._budget_ms, gather_ms=self._budget_ms / 2
                )
                self.sessions.append(Driven(str(defense["kind"]), opened))
        for number, session in enumerate(self.sessions):
            delay_s = number / len(self.sessions) / self._rate_hz
            self._driving.append(asyncio.create_task(self._drive(session, delay_s)))

    def begin(self, name: str) -> Phase:
        """Count what is asked from now on under another name."""
        self.phase = Phase(name)
        self.phases.append(self.phase)
        return self.phase

    async def stop(self) -> None:
        """Let every frame in hand end, and no other begin.

        Raises
        ------
        Exception
            As whatever ended the driving of a session before.
        """
        self._over = True
        await asyncio.gather(*self._driving)

    async def check(self) -> tuple[list[str], list[list[str]]]:
        """What is wrong with the sessions' logs, and which processes decided in each, one after another."""
        wrong, writers = [], []
        async with self._connect() as gateway:
            for number, session in enumerate(self.sessions):
                ego = session.ego(gateway)
                found = [complaint for line in await ego.audit_lines() for complaint in session.follow(line)]
                found += [f"frame {frame} was acknowledged and is not in the log" for frame in session.acknowledged]
                if (await ego.state())["audit_head"] != session.head:
                    found.append("the log does not end where the session says")
                wrong += [f"session {number}: {complaint}" for complaint in found]
                names = [r["gateway"] for r in await ego.audit() if r["event"] == "frame_answered"]
                writers.append([name for name, _ in groupby(names)])
        return wrong, writers

    async def _drive(self, session: Driven, delay_s: float) -> None:
        tokens = session.opened.teammate_tokens
        async with AsyncExitStack() as stack:
            gateway = await stack.enter_async_context(self._connect())
            ego = session.ego(gateway)
            team = {name: gateway.vehicle(session.opened.session_id, name, tokens[name]) for name in TEAM}
            standing = [await stack.enter_async_context(mate.standing_by()) for mate in team.values()]
            await asyncio.gather(*(stand.standing.wait() for stand in standing))
            start, latest = time.monotonic() + delay_s, time.monotonic() + delay_s
            waiting_since: float | None = None
            while not self._over:
                frame, session.next_frame = session.next_frame, session.next_frame + 1
                due = start + frame / self._rate_hz
                await asyncio.sleep(max(due - time.monotonic(), 0.0))
                phase, before = self.phase, sum(len(stand.sent_again) for stand in standing)
                waiting_since = waiting_since or time.monotonic()
                if await self._frame(session, ego, team, frame, phase):
                    now = time.monotonic()
                    phase.longest_gap_s = max(phase.longest_gap_s, now - latest)
                    phase.longest_wait_s = max(phase.longest_wait_s, now - waiting_since)
                    latest, waiting_since = now, None
                phase.sent_again += sum(len(stand.sent_again) for stand in standing) - before
                start = max(start, time.monotonic() - (frame + 1) / self._rate_hz)  # what is late delays what follows

    async def _frame(
        self, session: Driven, ego: VehicleClient, team: Mapping[str, VehicleClient], frame: int, phase: Phase
    ) -> bool:
        """All vehicles post; whether there was an answer."""
        phase.asked += 1
        sending = [asyncio.create_task(self._send(mate, name, frame, phase)) for name, mate in team.items()]
        began = time.perf_counter()
        try:
            answer = await ego.ask_body(self._bodies[EGO].numbered(frame))
        except FrameConflict:
            phase.refused["decided, the answer lost"] += 1
            return False
        except (GatewayUnavailable, GatewayUnreachable) as error:
            phase.refused[getattr(error, "type", type(error).__name__).rpartition(":")[2]] += 1
            await asyncio.sleep(REFUSED_WAIT_S)
            return False
        finally:
            taken = await asyncio.gather(*sending)
        session.acknowledged[frame] = answer
        self._count(phase, answer, (time.perf_counter() - began) * 1e3, all_sent=all(taken))
        return True

    async def _send(self, mate: VehicleClient, name: str, frame: int, phase: Phase) -> bool:
        try:
            await mate.send_body(self._bodies[name].numbered(frame))
        except GatewayError as error:
            phase.refused["a message: " + getattr(error, "type", type(error).__name__).rpartition(":")[2]] += 1
            return False
        return True

    def _count(self, phase: Phase, answer: FrameAnswer, latency_ms: float, *, all_sent: bool) -> None:
        phase.answered += 1
        phase.in_time += latency_ms <= self._budget_ms
        phase.tested += bool(answer.hypotheses)
        lacking = [why for why in answer.rejected.values() if why.reason == "missing"]
        phase.whole += not lacking
        phase.untold += all_sent and any(not (why.model_extra or {}).get("detail") for why in lacking)


def affinity(writers: Sequence[Sequence[str]], moves: int) -> list[str]:
    """What is wrong if sessions may have moved so often: each is decided by one process between two moves."""
    return [
        f"session {number} was decided by {len(names)} processes in turn, with {moves} moves"
        for number, names in enumerate(writers)
        if len(names) > moves + 1
    ]
