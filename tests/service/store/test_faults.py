"""The database fails while an ego posts frames: nothing acknowledged is lost, no answer belies its time, and at most
two frames later one is tested in time again.
"""

import asyncio
import contextlib
import os
import resource
import signal
import sqlite3
import subprocess
import time
from types import SimpleNamespace

import asyncpg
import pytest
from sqlalchemy import event, exc, make_url

from clients.client import AGAIN_FOR_S
from clients.crash_test.driven import Driven
from clients.errors import GatewayUnavailable
from robosac.audit.verification import verify
from service.keeping.patience import GRACE_S
from service.operations import STORE_PATIENCE_S
from tests.service.conftest import problem, serve

BUDGET_MS = 1000
FAULT_S = 2.5
CLOCK_MS = 20
"""What the ego's clock may see more than the gateway's."""
LATE_S = 0.5
"""What a busy machine may take longer than promised."""
WAITING_FOR_LOCKS = """
SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'
"""


@pytest.fixture(autouse=True)
def _one_try(monkeypatch):
    """Frames are not sent again, so that each fault is seen."""
    monkeypatch.setattr("clients.client.AGAIN_FOR_S", 0.0)


class Ego:
    """An ego that keeps account of what it was answered."""

    def __init__(self, served, session, good_frame):
        self.served, self.bodies = served, SimpleNamespace(numbered=good_frame)
        self.driven = Driven("sample_consensus", session)
        self.vehicle = served.ego(session)

    @classmethod
    async def of(cls, served, good_frame):
        ego = cls(served, await served.open(latency_budget_ms=BUDGET_MS, gather_ms=0), good_frame)
        in_a_row = 0
        while in_a_row < 3:
            in_a_row = in_a_row + 1 if await ego.post() else 0
            assert ego.driven.next_frame < 60
        return ego

    async def post(self):
        """Post the next frame; whether it was tested in time."""
        began = time.perf_counter()
        try:
            await self.driven.post(self.vehicle, self.bodies)
        except GatewayUnavailable:
            assert time.perf_counter() - began < BUDGET_MS / 1e3 + 2 * GRACE_S + LATE_S
            return False
        took_ms = (time.perf_counter() - began) * 1e3
        answer = self.driven.acknowledged[self.driven.next_frame - 1]
        assert not answer.deadline_met or took_ms < BUDGET_MS + CLOCK_MS
        return answer.deadline_met and answer.degraded_by is None and answer.source != "ego_only"

    async def post_for(self, seconds):
        """Frames until then; how many were refused, or not tested in time."""
        until, failed = time.perf_counter() + seconds, 0
        while time.perf_counter() < until:
            failed += not await self.post()
            await asyncio.sleep(0.02)
        return failed

    async def check(self):
        """It goes on, and everything is as it was told."""
        assert await self.post() or await self.post() or await self.post(), "not recovered after two frames"
        assert await self.driven.check(self.served.client, self.bodies) == []
        lines = await self.vehicle.audit_lines()
        head = (await self.vehicle.state())["audit_head"]
        assert verify((line.encode() for line in lines), head) == []


@pytest.mark.parametrize("fault", ["stopped", "killed"])
async def test_a_server_that_stands_still_or_dies(fault, postgres, good_frame):
    async with serve(database_url=await postgres.new_database(), keep_frames=1) as served:
        ego = await Ego.of(served, good_frame)
        postgres.send(signal.SIGSTOP if fault == "stopped" else signal.SIGKILL)
        try:
            if fault == "stopped":  # the connections look good
                began = time.perf_counter()
                problem(await served.http.get("/readyz"), 503, "not-ready")
                assert time.perf_counter() - began < STORE_PATIENCE_S + LATE_S
            assert await ego.post_for(FAULT_S)
        finally:
            if fault == "stopped":
                postgres.send(signal.SIGCONT)
            else:
                await asyncio.to_thread(postgres.start)
        await ego.check()
        assert (await served.http.get("/readyz")).status_code == 200


async def test_a_session_whose_row_is_held_takes_one_connection(postgres, good_frame):
    url = await postgres.new_database()
    async with serve(database_url=url, database_statement_s=30) as served:
        other = await Ego.of(served, good_frame)
        held = await served.open(latency_budget_ms=400, gather_ms=0)
        holding = await asyncpg.connect(url.replace("+asyncpg", ""))
        async with holding.transaction():
            await holding.execute("SELECT 1 FROM sessions WHERE session_id = $1 FOR UPDATE", held.session_id)
            for frame in range(3):
                problem(await served.post(held, "frames", good_frame(frame)), 503, "store-too-slow")
            assert await holding.fetchval(WAITING_FOR_LOCKS) == 1
            assert await other.post_for(0.5) == 0
        await holding.close()
        assert (await served.post(held, "frames", good_frame(3))).status_code == 200
        await other.check()


async def test_a_server_that_only_reads_for_a_while(postgres, good_frame):
    url = await postgres.new_database()
    name = make_url(url).database
    async with serve(database_url=url, keep_frames=1) as served:
        ego = await Ego.of(served, good_frame)
        await postgres.do(
            f"ALTER DATABASE {name} SET default_transaction_read_only = on",
            f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name}'",
        )
        assert await ego.post_for(0.5)
        problem(await served.http.get("/readyz"), 503, "store-unavailable")
        await postgres.do(f"ALTER DATABASE {name} RESET default_transaction_read_only")
        await ego.check()
        assert (await served.http.get("/readyz")).status_code == 200


@contextlib.contextmanager
def no_file_may_grow(path, more=0):
    """Beyond what the journal has, and so many bytes: the system refuses the write."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.with_name(f"{path.name}-wal").stat().st_size + more, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))


@contextlib.contextmanager
def no_space_left(path):
    """On the disk of the database."""
    filler = path.with_name("filler")
    with filler.open("wb", buffering=0) as out, contextlib.suppress(OSError):
        while out.write(bytes(4096)):
            pass
    try:
        yield
    finally:
        filler.unlink()


@contextlib.contextmanager
def a_small_disk(folder, size="8m"):
    folder.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=777", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mounting, check=False, capture_output=True).returncode:
        pytest.skip("no disk of one's own without root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


async def on_a_full_disk(path, full, good_frame):
    async with serve(database_url=f"sqlite:///{path}") as served:
        ego = await Ego.of(served, good_frame)
        with full(path):
            assert await ego.post_for(0.5)
            assert (await served.http.get("/healthz")).status_code == 200
            problem(await served.http.get("/readyz"), 503, "store-unavailable")
        assert (await served.http.get("/readyz")).status_code == 200  # though nobody has sent a frame
        await ego.check()


async def test_a_file_that_may_not_grow(tmp_path, good_frame):
    await on_a_full_disk(tmp_path / "robosac.db", no_file_may_grow, good_frame)


async def test_a_file_with_room_for_little_is_told_as_long_as_frames_are_refused(tmp_path, good_frame):
    path = tmp_path / "robosac.db"
    async with serve(database_url=f"sqlite:///{path}") as served:
        ego = await Ego.of(served, good_frame)
        for more in range(16_000, 48_000, 2_000):  # of which a page may be left, or several
            with no_file_may_grow(path, more):
                while await ego.post():
                    pass
                problem(await served.http.get("/readyz"), 503, "store-unavailable")
            assert (await served.http.get("/readyz")).status_code == 200
        await ego.check()


async def test_a_disk_that_is_full(tmp_path, good_frame):
    with a_small_disk(tmp_path / "disk") as folder:
        await on_a_full_disk(folder / "robosac.db", no_space_left, good_frame)


@pytest.mark.parametrize("room", [0.25, 1.0])
async def test_a_disk_with_room_for_little_is_told_as_long_as_frames_are_refused(tmp_path, good_frame, room):
    with a_small_disk(tmp_path / "disk", "64m") as folder:
        path = folder / "robosac.db"
        async with serve(database_url=f"sqlite:///{path}", keep_frames=2) as served:
            ego = await Ego.of(served, good_frame)
            with contextlib.closing(sqlite3.connect(path)) as other:  # what is there already has to be in the file
                other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            with no_space_left(folder / "some"):
                filler = folder / "filler"
                os.truncate(filler, filler.stat().st_size - int(room * 2**20))
                for _ in range(4):
                    assert not await ego.post()
                    assert (await served.http.get("/readyz")).status_code == 503
            assert (await served.http.get("/readyz")).status_code == 200
            await ego.check()


async def test_a_full_disk_of_a_server_is_told_as_long_as_frames_are_refused(postgres, good_frame):
    with a_small_disk(postgres.folder / "disk", "32m") as disk:
        place = disk / "tables"
        place.mkdir()
        os.chown(place, postgres.folder.stat().st_uid, postgres.folder.stat().st_gid)
        await postgres.do(f"CREATE TABLESPACE small LOCATION '{place}'")
        url = await postgres.new_database("TABLESPACE small")
        try:
            async with serve(database_url=url) as served:
                ego, ready = await Ego.of(served, good_frame), []
                with no_space_left(disk / "some"):
                    while len(ready) < 20:
                        if not await ego.post():
                            ready.append((await served.http.get("/readyz")).status_code)
                assert (await served.http.get("/readyz")).status_code == 200
                await ego.check()
            assert set(ready) == {503}
        finally:
            await postgres.do(f"DROP DATABASE {make_url(url).database}", "DROP TABLESPACE small")


class Breaking:
    """Lets one of the next statements on SQLite's connections fail, or one of the next commits."""

    def __init__(self, database):
        self.count, self.at = 0, None
        for threads in (database._readers, database._writer):
            event.listen(threads.engine, "do_execute", self._statement)
            event.listen(threads.engine, "commit", self._commit)

    def _is_next(self):
        self.count += 1
        return self.count - 1 == self.at

    def _statement(self, *_):
        if self._is_next():
            raise sqlite3.OperationalError("disk I/O error")

    def _commit(self, _):
        if self._is_next():
            raise exc.OperationalError("COMMIT", {}, sqlite3.OperationalError("disk I/O error"))

    def arm(self, at):
        self.count, self.at = 0, at


async def test_an_error_at_each_statement_of_a_decision_in_turn(tmp_path, good_frame):
    async with serve(database_url=f"sqlite:///{tmp_path}/robosac.db", keep_frames=1) as served:
        breaking = Breaking(served.gateway.store._database)
        ego = await Ego.of(served, good_frame)
        breaking.arm(None)
        assert await ego.post()
        statements = breaking.count
        assert statements >= 8
        for at in range(statements):
            breaking.arm(at)
            assert not await ego.post(), at
            assert breaking.count > at
            breaking.arm(None)
            await ego.check()


async def test_a_frame_that_met_an_error_is_sent_again(tmp_path, good_frame, monkeypatch):
    monkeypatch.setattr("clients.client.AGAIN_FOR_S", AGAIN_FOR_S)
    async with serve(database_url=f"sqlite:///{tmp_path}/robosac.db", keep_frames=1) as served:
        breaking = Breaking(served.gateway.store._database)
        ego = await Ego.of(served, good_frame)
        breaking.arm(2)
        assert await ego.post()
        assert breaking.count > 2
        breaking.arm(None)
        await ego.check()


class Wire:
    """Between a gateway and PostgreSQL: cuts the connection at one of the gateway's next messages."""

    def __init__(self, server):
        self.server, self.serving = server, set()
        self.arm(None)

    @contextlib.asynccontextmanager
    async def between(self, folder):
        async with await asyncio.start_unix_server(self._serve, folder / ".s.PGSQL.5432"):
            yield
            await asyncio.gather(*self.serving)

    def arm(self, at, *, delivered=False):
        """Cut at this message from now on, before or after the server has done what it says."""
        self.count, self.at, self.delivered = 0, at, delivered

    async def _serve(self, reader, writer):
        self.serving.add(asyncio.current_task())
        answers, there = await asyncio.open_unix_connection(f"{self.server.folder}/.s.PGSQL.5432")
        back = asyncio.create_task(self._answer(answers, writer))
        while chunk := await reader.read(2**20):
            self.count += 1
            cut = self.count - 1 == self.at
            if cut:
                back.cancel()
                await asyncio.wait({back})
            if not cut or self.delivered:
                there.write(chunk)
            if cut:
                if self.delivered:  # it has done it once it answers, unless this was but a part of a message
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(answers.read(1), 0.2)
                break
        for one in (there, writer):
            one.close()
            with contextlib.suppress(OSError):
                await one.wait_closed()
        await asyncio.wait({back})

    @staticmethod
    async def _answer(answers, writer):
        with contextlib.suppress(OSError):
            while chunk := await answers.read(2**20):
                writer.write(chunk)
        writer.close()


async def test_a_connection_that_breaks_at_each_message_of_a_decision_in_turn(postgres, tmp_path, good_frame):
    wire = Wire(postgres)
    url = (await postgres.new_database()).replace(str(postgres.folder), str(tmp_path))
    async with wire.between(tmp_path), serve(database_url=url) as served:
        ego = await Ego.of(served, good_frame)
        wire.arm(None)
        assert await ego.post()
        messages = wire.count
        assert messages >= 6
        for at in range(messages):
            for delivered in (False, True):
                wire.arm(at, delivered=delivered)
                assert not await ego.post(), (at, delivered)
                wire.arm(None)
                await ego.check()
