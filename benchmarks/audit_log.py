"""A log of 24 h of one session at 5 Hz, made quickly: its size, and what it costs to read, verify and purge.

The gateway opens a session of five teammates and answers real frames; their records, with other numbers and seeds, are
then chained to as many as asked for, straight into the database. Meanwhile another session opens and closes its team.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import secrets
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated

import httpx
import numpy as np
import typer
from rich.console import Console

from clients.client import GatewayClient, OpenedSession, VehicleClient
from clients.load_test import EGO, TEAM, prepare
from clients.local_gateway import GatewayProcess
from robosac.audit import Unsealed, commitment, digest

BATCH = 5000
PATTERN_FRAMES = 20


def main(records: int = 432_000, folder: Annotated[Path | None, typer.Option(help="On the disk to measure.")] = None):
    """Print sizes, times and peak memory."""
    with tempfile.TemporaryDirectory(dir=folder) as path:
        asyncio.run(measure(Path(path), records))


async def measure(folder: Path, records: int) -> None:
    database = folder / "robosac.db"
    os.environ.update(ROBOSAC_SESSION_IDLE_S="3600", ROBOSAC_AUDIT_RETENTION_S="0.001", ROBOSAC_TOKEN_TTL_S="86400")
    async with running(folder) as (process, url), GatewayClient(url, timeout_s=600) as gateway:
        session = await gateway.open_session(EGO, TEAM)
        ego = gateway.vehicle(session.session_id, EGO, session.ego_token)
        bodies = prepare(attacked=True, scene_seed=0, console=Console(stderr=True), frames=PATTERN_FRAMES)
        for frame in range(PATTERN_FRAMES):
            await ego.post_frame_body(bodies.numbered(frame))
    started = time.perf_counter()
    nbytes = extend(database, session.session_id, records)
    print(f"{records} records of {nbytes / records:.0f} bytes, database {database.stat().st_size / 2**20:.0f} MiB, "
          f"made in {time.perf_counter() - started:.0f} s")  # fmt: skip
    async with running(folder) as (process, url), GatewayClient(url, timeout_s=600) as gateway:
        await read_all(process, gateway, url, session, folder / "log.jsonl")
        verify(folder / "log.jsonl")
        await purge(gateway, session, database)


@contextlib.asynccontextmanager
async def running(folder: Path) -> AsyncIterator[tuple[GatewayProcess, str]]:
    process = GatewayProcess(folder / "gateway.log", f"sqlite:///{folder}/robosac.db")
    try:
        await process.ready()
        yield process, process.url
    finally:
        await process.stop()


def extend(database: Path, session_id: str, records: int) -> int:
    """Chain copies of a session's frames to its log; the bytes of all its lines."""
    with sqlite3.connect(database) as connection:
        lines = [line for (line,) in connection.execute(
            "SELECT line FROM audit_lines WHERE session_id = ? ORDER BY seq", (session_id,))]  # fmt: skip
        pattern = [json.loads(line) for line in lines if '"event":"frame_answered"' in line]
        frames = [Unsealed(record) for record in pattern]
        nbytes, head, seq = sum(map(len, lines)), digest(lines[-1]), len(lines)
        frame = pattern[-1]["frame"]
        (seed,) = connection.execute("SELECT seed FROM sessions WHERE session_id = ?", (session_id,)).fetchone()
        while seq < records:
            rows = []
            for _ in range(min(BATCH, records - seq)):
                seq, frame, following = seq + 1, frame + 1, secrets.token_hex(32)
                copied = frames[frame % 100 and 1 + frame % (len(frames) - 1)]
                copied.parts.update(frame=str(frame).encode(), seed=f'"{seed}"'.encode(),
                                    next_seed_commitment=f'"{commitment(following)}"'.encode())  # fmt: skip
                line = copied.seal(session_id, seq, head)
                head, seed, nbytes = digest(line), following, nbytes + len(line)
                rows.append((session_id, seq, line))
            connection.executemany("INSERT INTO audit_lines (session_id, seq, line) VALUES (?, ?, ?)", rows)
        connection.execute("UPDATE sessions SET audit_seq = ?, audit_head = ?, last_frame = ?, seed = ? "
                           "WHERE session_id = ?", (seq, head, frame, seed, session_id))  # fmt: skip
    return nbytes


async def read_all(
    process: GatewayProcess, gateway: GatewayClient, url: str, session: OpenedSession, file: Path
) -> None:
    before, started = memory(process), time.perf_counter()
    async with disturbed(gateway) as waits, httpx.AsyncClient(base_url=url, timeout=600) as http:
        bearer = {"Authorization": f"Bearer {session.ego_token}"}
        with file.open("wb") as out:
            async with http.stream("GET", f"/v1/sessions/{session.session_id}/audit", headers=bearer) as answer:
                answer.raise_for_status()
                async for chunk in answer.aiter_bytes():
                    out.write(chunk)
    print(f"GET /audit: {time.perf_counter() - started:.1f} s, {file.stat().st_size / 2**20:.0f} MiB; the gateway's "
          f"memory {before} MiB before, at most {memory(process)} MiB; {shown(waits)}")  # fmt: skip


def verify(file: Path) -> None:
    started = time.perf_counter()
    command = [sys.executable, "-c", "from robosac.cli import app; app()", "audit", "verify", str(file)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    said = done.stdout.strip()[-160:]
    print(f"verify: {time.perf_counter() - started:.1f} s, the largest child so far {peak} MiB; {said}")


async def purge(gateway: GatewayClient, session: OpenedSession, database: Path) -> None:
    started = time.perf_counter()
    async with disturbed(gateway) as waits:
        await gateway.vehicle(session.session_id, EGO, session.ego_token).close()
        with sqlite3.connect(database) as connection:
            count = "SELECT count(*) FROM sessions WHERE session_id = ?"
            began = None
            while connection.execute(count, (session.session_id,)).fetchone()[0]:
                first = connection.execute("SELECT min(seq) FROM audit_lines WHERE session_id = ?",
                                           (session.session_id,)).fetchone()[0]  # fmt: skip
                if began is None and first != 1:
                    began = time.perf_counter()
                await asyncio.sleep(0.05)
    print(f"purge: {time.perf_counter() - (began or started):.1f} s; {shown(waits)}")


@contextlib.asynccontextmanager
async def disturbed(gateway: GatewayClient) -> AsyncIterator[list[float]]:
    """How long another session's changes take, each a transaction, one after another (seconds)."""
    other = await gateway.open_session("other", ["mate"])
    ego, waits = gateway.vehicle(other.session_id, "other", other.ego_token), []
    task = asyncio.create_task(change_for_ever(ego, waits))
    try:
        yield waits
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        await ego.close()


async def change_for_ever(ego: VehicleClient, waits: list[float]) -> None:
    while True:
        for change in (lambda: ego.dismiss("mate"), lambda: ego.enrol(["mate"])):
            started = time.perf_counter()
            await change()
            waits.append(time.perf_counter() - started)
            await asyncio.sleep(0.05)


def memory(process: GatewayProcess) -> int:
    """The most memory that a process had so far, MiB."""
    status = Path(f"/proc/{process._process.pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) // 1024


def shown(waits: list[float]) -> str:
    median, worst = np.percentile(waits, [50, 100]) * 1e3
    return f"another session's {len(waits)} changes took {median:.0f} ms, at most {worst:.0f} ms"


if __name__ == "__main__":
    typer.run(main)
