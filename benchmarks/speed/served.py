"""Frames over HTTP against the same frames in process, and what many sessions get of one gateway."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np
from speed.embedded import sequence
from speed.turns import Part, Row, row

from clients.client import GatewayClient
from clients.cores import Cores
from clients.load_test import DEFENSE, TEAM, Bodies, new_ego
from clients.local_gateway import GatewayProcess
from robosac import wire
from robosac.detectors import load
from robosac.evaluation.frames import EvaluationFrame
from robosac.session import Session, defense_for

SECONDS = {1: 6.0, 8: 6.0, 100: 20.0}
"""Of a load, by how many sessions."""
FRAMES = 60
"""In process, a turn."""
WARM_UP = 8
BUDGET_MS = 20_000.0
DEFENSES = {"sample consensus": DEFENSE, "group testing": {"kind": "group_testing"}}
TEXT = f"""A gateway in a process of its own, on a core of its own where there are two, with SQLite; one session posts
whole frames in a closed loop. *In process* is `Session.answer` with the messages at hand. Loads of {SECONDS[1]:g} s and
batches of {FRAMES} frames take turns."""
SHARED = """The same gateway with more sessions at a time (sample consensus), all in closed loops."""


def parts(turns: int) -> list[Part]:
    """Measure them."""
    return asyncio.run(_measured(max(2, turns // 5)))


async def _measured(rounds: int) -> list[Part]:
    frames, cores, rows = sequence(0), Cores(), []
    bodies = Bodies([wire.pack_frame(0, met.ego, {name: met.teammates[name] for name in TEAM}) for met in frames])
    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        with cores.of_gateways():
            process = GatewayProcess(Path(folder, "gateway.log"), f"sqlite:///{folder}/robosac.db")
        try:
            await process.ready()
            for name, defense in DEFENSES.items():
                inside, outside = [], []
                for turn in range(rounds):
                    inside.append(_in_process(defense, frames, turn))
                    before = process.cpu_s()
                    counts, _ = await _driven(process.url, 1, bodies, defense)
                    outside.append((process.cpu_s() - before) / (sum(counts) + WARM_UP))
                base = float(np.median(inside))
                rows.append(row(f"{name}: processor time of a frame over HTTP", outside, base, "the same in process"))
            shared = await _shared(process.url, bodies, rounds)
        finally:
            await process.stop()
    return [Part("Over HTTP", TEXT, rows), Part("Many sessions", SHARED, shared)]


def _in_process(defense: dict[str, object], frames: Sequence[EvaluationFrame], seed: int) -> float:
    """Seconds of processor time of a frame."""
    detector = load()
    session = Session(detector, TEAM, defense_for(defense, detector.info), rng=np.random.default_rng(seed))
    order = [*frames, *frames[-2:0:-1]]  # there and back, as `Bodies`
    began = time.process_time()
    for index in range(WARM_UP + FRAMES):
        if index == WARM_UP:
            began = time.process_time()
        met = order[index % len(order)]
        session.answer(index, met.ego, met.teammates)
    return (time.process_time() - began) / FRAMES


async def _shared(url: str, bodies: Bodies, rounds: int) -> list[Row]:
    rates: dict[int, list[float]] = {sessions: [] for sessions in SECONDS}
    least: dict[int, list[float]] = {sessions: [] for sessions in SECONDS}
    for _ in range(rounds):
        for sessions in SECONDS:
            counts, seconds = await _driven(url, sessions, bodies, DEFENSE)
            rates[sessions].append(sum(counts) / seconds)
            least[sessions].append(min(counts) / (sum(counts) / sessions))
    base, rows = float(np.median(rates[1])), []
    for sessions in list(SECONDS)[1:]:
        rows.append(row(f"{sessions} sessions: frames a second", rates[sessions], base, "those of one"))
        rows.append(row(f"{sessions} sessions: frames of the one with the fewest", least[sessions], 1.0, "the mean"))
    return rows


async def _driven(url: str, sessions: int, bodies: Bodies, defense: dict[str, object]) -> tuple[list[int], float]:
    """Frames answered of each session in a closed loop, after some that do not count, and for how long."""
    counts, started = [0] * sessions, 0.0
    async with GatewayClient(url, timeout_s=60.0) as gateway, AsyncExitStack() as stack:
        egos = [await new_ego(gateway, BUDGET_MS, bodies.team, defense) for _ in range(sessions)]
        for ego in egos:
            stack.push_async_callback(ego.close)
        for index in range(WARM_UP):
            await asyncio.gather(*(ego.post_frame_body(bodies.numbered(index)) for ego in egos))
        started = time.perf_counter()

        async def drive(number: int) -> None:
            while time.perf_counter() - started < SECONDS[sessions]:
                await egos[number].post_frame_body(bodies.numbered(WARM_UP + counts[number]))
                counts[number] += 1

        await asyncio.gather(*(drive(number) for number in range(sessions)))
        seconds = time.perf_counter() - started
    return counts, seconds
