"""What 1,000 sessions' decisions cost PostgreSQL: ``python benchmarks/postgresql.py --database-url URL``.

Decisions are written as a gateway writes them, so many at a time, into databases made for it beside the one that is
named: by one session after another, or by one session alone; with the log in parts by day, or in one table. Then the
ended sessions are forgotten, by dropping their day or by deleting their lines. Rounds take turns, and medians are told.
"""

from __future__ import annotations

import argparse
import asyncio
import statistics
import time
from collections.abc import Sequence
from typing import Any

import asyncpg
from sqlalchemy import make_url

from robosac.audit.events import SessionEnded, now
from service.keeping import partitions, purging
from service.keeping.limits import Limits
from service.keeping.store import Store
from tests.service.store.conftest import Event, a_decision, a_session

ONE_TABLE = (
    "CREATE TABLE one_table (LIKE audit_lines INCLUDING DEFAULTS, PRIMARY KEY (session_id, seq), "
    "FOREIGN KEY (session_id) REFERENCES sessions ON DELETE CASCADE)",
    "DROP TABLE audit_lines",
    "ALTER TABLE one_table RENAME TO audit_lines",
)


async def run(url: str, *statements: str) -> None:
    connection = await asyncpg.connect(url.replace("+asyncpg", ""))
    for statement in statements:
        await connection.execute(statement)
    await connection.close()


async def writes(store: Store, sids: Sequence[str], decisions: int, at_once: int) -> tuple[float, list[float]]:
    """Decisions a second, and how long each took, milliseconds."""
    turns, took = iter(range(decisions)), list[float]()
    locks = {sid: asyncio.Lock() for sid in sids}
    padding = {"suspicion": [i / 1000 for i in range(100)]}  # a state of about 1 kB

    async def worker() -> None:
        for turn in turns:
            sid = sids[turn % len(sids)]
            async with locks[sid]:
                record = store.seen(sid) or await store.get(sid)
                assert record is not None
                frame = (record.last_frame or 0) + 1
                began = time.perf_counter()
                await store.decide(record, a_decision(frame, **padding), f"{turn:064x}")
                took.append((time.perf_counter() - began) * 1e3)

    began = time.perf_counter()
    await asyncio.gather(*(worker() for _ in range(at_once)))
    return decisions / (time.perf_counter() - began), took


async def measure(url: str, sessions: int, decisions: int, at_once: int, *, parts: bool) -> dict[str, Any]:
    name = f"bench_{time.monotonic_ns()}"
    await run(url, f"CREATE DATABASE {name}")
    own = make_url(url).set(database=name).render_as_string(hide_password=False)
    store = Store(own, limits=Limits(statement_s=60.0))
    try:
        await store.start()
        if not parts:
            await run(own, *ONE_TABLE)
        sids = [f"{number:032x}" for number in range(sessions)]
        for number in range(sessions):
            await store.create(a_session(number), Event(event="session_opened"))
        await writes(store, sids, min(sessions, 200), at_once)  # until connections are there
        rate, took = await writes(store, sids, decisions, at_once)
        for sid in sids:
            await store.end(sid, SessionEnded(why="closed", time=now()))
        old = partitions.day() - 9
        if parts:  # as if all of it had happened nine days ago
            await run(
                own,
                f"CREATE TABLE {partitions.name_of(old)} PARTITION OF audit_lines "
                f"FOR VALUES FROM ({old}) TO ({old + 1})",
                f"UPDATE audit_lines SET day = {old}",
            )
        await run(own, f"UPDATE sessions SET touched_at = {time.time() - 8 * partitions.DAY_S}", "VACUUM ANALYZE")
        began = time.perf_counter()
        if parts:
            await store.purge(time.time() - 7 * partitions.DAY_S)
        else:
            for sid in sids:
                for some in purging.parts(sid):
                    while await store._execute(some):
                        pass
        forgot = time.perf_counter() - began
    finally:
        await store.close()
        await run(url, f"DROP DATABASE {name}")
    took.sort()
    return {
        "per_s": rate,
        "p50_ms": took[len(took) // 2],
        "p99_ms": took[len(took) * 99 // 100],
        "forgetting_s": forgot,
    }


async def main(given: argparse.Namespace) -> None:
    kinds = {
        f"{given.sessions} sessions, parts": (given.sessions, True),
        f"{given.sessions} sessions, one table": (given.sessions, False),
        "1 session, parts": (1, True),
        "1 session, one table": (1, False),
    }
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in kinds}
    for _ in range(given.rounds):
        for kind, (sessions, parts) in kinds.items():
            found[kind].append(await measure(given.database_url, sessions, given.decisions, given.at_once, parts=parts))
    print(f"{given.decisions} decisions, {given.at_once} at a time, medians of {given.rounds} rounds")
    for kind, results in found.items():
        told = {name: statistics.median(result[name] for result in results) for name in results[0]}
        print(f"{kind:28}", ", ".join(f"{name} {value:.2f}" for name, value in told.items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--database-url", required=True, help="Where databases can be made.")
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--decisions", type=int, default=3000)
    parser.add_argument("--at-once", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    asyncio.run(main(parser.parse_args()))
