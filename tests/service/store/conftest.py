import asyncio
import contextlib
import json
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import asyncpg
import numpy as np
import pytest

from robosac.audit import GENESIS, digest
from robosac.audit.events import FrameAnswered
from service.keeping.record import SessionRecord
from service.keeping.store import Store

NUMBERS = count()


@dataclass
class Server:
    """A PostgreSQL server of one's own, on a socket in a folder of its own."""

    programs: Path
    folder: Path
    user: list[str]

    @property
    def options(self) -> list[str]:
        quick = "-c fsync=off -c full_page_writes=off -c max_connections=60"
        return ["-o", f"-c listen_addresses= -c unix_socket_directories={self.folder} {quick}"]

    def run(self, program: str, *arguments: str) -> None:
        command = [*self.user, str(self.programs / program), "-D", str(self.folder / "data"), *arguments]
        done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=self.folder)
        assert done.returncode == 0, done.stdout + done.stderr

    def start(self) -> None:
        self.run("pg_ctl", "start", "--wait", "--silent", "-l", str(self.folder / "log"), *self.options)

    def stop(self) -> None:
        self.run("pg_ctl", "stop", "--wait", "--silent", "--mode=immediate")

    def send(self, number: signal.Signals) -> None:
        """A signal to the server and to all that serve its connections."""
        first = int((self.folder / "data" / "postmaster.pid").read_text().split()[0])
        children = subprocess.run(["ps", "-o", "pid=", "--ppid", str(first)], check=False, capture_output=True).stdout
        for process in (first, *map(int, children.split())):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)

    async def do(self, *statements: str) -> None:
        connection = await asyncpg.connect(host=str(self.folder), user="postgres", database="postgres")
        for statement in statements:
            await connection.execute(statement)
        await connection.close()

    async def new_database(self, options: str = "") -> str:
        name = f"gateway{next(NUMBERS)}"
        await self.do(f"CREATE DATABASE {name} {options}")
        return f"postgresql+asyncpg://postgres@/{name}?host={self.folder}"


def _programs() -> Path | None:
    found = shutil.which("initdb")
    places = [Path(found).parent] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((place for place in places if (place / "initdb").exists()), None)


def _unprivileged(folder: Path) -> list[str]:
    """The server refuses to run as root: what to put before its programs, whose folder is then another user's."""
    if os.geteuid() != 0:
        return []
    names = {entry.pw_name for entry in pwd.getpwall()}
    user = pwd.getpwnam("postgres" if "postgres" in names else "nobody")
    os.chown(folder, user.pw_uid, user.pw_gid)
    return ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"]


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    programs = _programs()
    if programs is None:
        pytest.skip("no PostgreSQL server program")
    folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))  # a socket's path must be short
    server = Server(programs, folder, _unprivileged(folder))
    try:
        server.run("initdb", "--username=postgres", "--auth=trust", "--encoding=UTF8", "--no-sync", "--no-instructions")
        server.start()
        yield server
        server.stop()
    finally:
        shutil.rmtree(folder)


async def _empty(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "postgresql":
        server: Server = request.getfixturevalue("postgres")
        return await server.new_database()
    return "sqlite://" if request.param == "memory" else f"sqlite:///{tmp_path}/robosac.db"


@pytest.fixture(params=["sqlite", "memory", "postgresql"])
async def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database."""
    return await _empty(request, tmp_path)


@pytest.fixture(params=["sqlite", "postgresql"])
async def shared_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database that several stores can share."""
    return await _empty(request, tmp_path)


@contextlib.asynccontextmanager
async def opened(url: str) -> AsyncIterator[Store]:
    store = Store(url)
    try:
        await store.start()
        yield store
    finally:
        await store.close()


@pytest.fixture
async def store(url: str) -> AsyncIterator[Store]:
    async with opened(url) as store:
        yield store


class Event(SimpleNamespace):
    """What a store asks of an event: its JSON, and the fields that it keeps beside the log."""

    def as_json(self) -> dict[str, object]:
        return dict(vars(self))


def note(**fields: object) -> Event:
    return Event(**{"event": "note", **fields})


def a_decision(frame: int = 1, **state: object) -> FrameAnswered:
    return FrameAnswered(
        frame=frame, boxes=np.zeros((0, 6)), source="ego_only", accepted=(), rejected={}, hypotheses=(),
        sampling_steps=0, attacker_ratio=None, deadline_met=True, degraded_by=None, timings_ms={}, seed="00",
        ego_pose=np.eye(4), messages={}, out_of_time=False, state=state, next_seed_commitment="",
    )  # fmt: skip


A_TOKEN = Event(event="token_renewed", vehicle_id="a")
A_TEAM = Event(event="team_changed", teammates=("a",), public_keys={}, state={"trusted": []})
THE_END = Event(event="session_ended", time="2025-01-01T01:00:00Z")


def a_session(number: int = 0, **changes: object) -> SessionRecord:
    values = {
        "session_id": f"{number:032x}", "ego_id": "ego", "teammates": ("a", "b"), "detector": "d",
        "defense": {"kind": "static_team", "attacker_ratio": 0.2, "note": "ünïcode \u0000 '; DROP TABLE sessions; --"},
        "latency_budget_ms": 200.0, "gather_ms": 100.5, "frame_period_ms": 200.0,
        "token_ids": {"ego": "t0", "a": "t1", "b": "t2"}, "public_keys": {"a": "key"},
        "created_at": "2025-01-01T00:00:00Z", "seed": "ab" * 32,
        "state": {"trusted": ["a"], "counters": [1, 2.5, None]},
    }  # fmt: skip
    return SessionRecord(**{**values, **changes})


async def added(store: Store, number: int = 0, **changes: object) -> str:
    record = a_session(number, **changes)
    await store.create(record, Event(event="session_opened"))
    return record.session_id


async def decided(store: Store, sid: str, frame: int, **state: object) -> None:
    await store.decide(await store.get(sid), a_decision(frame, **state), f"{frame:064x}")


async def check_chain(store: Store, sid: str) -> list[str]:
    """The log, whose chain ends at the session's head."""
    lines, before = await store.audit(sid, 0), GENESIS
    for seq, line in enumerate(lines, 1):
        record = json.loads(line)
        assert (record["seq"], record["previous"], record["session_id"]) == (seq, before, sid)
        before = digest(line)
    kept = await store.get(sid)
    assert (kept.audit_seq, kept.audit_head) == (len(lines), before)
    return lines


async def all_of(*calls: object) -> list[object]:
    return await asyncio.gather(*calls, return_exceptions=True)
