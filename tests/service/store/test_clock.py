"""A gateway whose clock is not the database's, or is set while it runs."""

import asyncio
import time
from types import SimpleNamespace

import pytest

from service.sessions.clock import Clock
from service.sessions.sessions import Sessions
from tests.service.conftest import serve


@pytest.mark.parametrize(("skew_s", "said"), [(3600, "3600 s ahead of"), (-3600, "3600 s behind")])
async def test_a_gateway_whose_clock_is_wrong_ends_and_purges_nothing(skew_s, said, postgres, monkeypatch, caplog):
    right = time.time
    settings = {"session_idle_s": 600, "audit_retention_s": 0.01}
    async with serve(database_url=await postgres.new_database(), **settings) as served:
        store, sweep = served.gateway.store, served.gateway.sessions.sweep
        over, unused = [await served.open() for _ in range(2)]
        await served.ego(over).close()
        served.gateway.sessions._forget(unused.session_id)  # as if another gateway answered it
        with monkeypatch.context() as patched:
            patched.setattr(time, "time", lambda: right() + skew_s)
            await sweep()
            await sweep()
        assert (await store.get(unused.session_id)).ended_at is None
        assert len(await store.audit(over.session_id, 0)) == 2
        assert caplog.text.count(said) == 1
        await sweep()
        await asyncio.sleep(0.02)
        await sweep()
        assert await store.audit(over.session_id, 0) == []


@pytest.mark.parametrize("skew_s", [-8 * 86400, 8 * 86400])
async def test_what_a_gateway_with_a_wrong_clock_keeps_is_as_old_as_it_is(skew_s, postgres, monkeypatch):
    right = time.time
    monkeypatch.setattr(Clock, "stepped_s", lambda *_: 0.0)  # here two clocks, of which one is right all the time
    monkeypatch.setattr(Sessions, "expire_idle", lambda _: asyncio.Event().wait())  # which no sweep sees change
    settings = {"session_idle_s": 2, "audit_retention_s": 1}
    async with serve(database_url=await postgres.new_database(), **settings) as served:
        store, sessions = served.gateway.store, served.gateway.sessions
        with monkeypatch.context() as patched:
            patched.setattr(time, "time", lambda: right() + skew_s)
            await store.make_ahead()  # as if it had started so
            over, read, unused = [await served.open() for _ in range(3)]
            await served.ego(over).close()
        sessions._forget(unused.session_id)  # as if another gateway had answered it
        await sessions.sweep()
        assert len(await store.audit(over.session_id, 0)) == 2
        assert (await store.get(unused.session_id)).ended_at is None
        await asyncio.sleep(1.5)
        with monkeypatch.context() as patched:
            patched.setattr(time, "time", lambda: right() + skew_s)
            await served.gateway.sessions.authenticate(read.session_id, read.ego_token)
            await sessions.sweep()  # tells the store that it is used here
        sessions._forget(read.session_id)
        await asyncio.sleep(1.6)
        await sessions.sweep()
        assert await store.audit(over.session_id, 0) == []
        assert (await store.get(read.session_id)).ended_at is None
        assert (await store.get(unused.session_id)).ended_at is not None


async def test_what_was_written_before_the_clock_was_set_right_is_no_older_for_it(url, monkeypatch, caplog):
    day_s = 86400
    later_s, behind_s = [0.0], [20 * 365 * day_s]
    right, running = time.time, time.monotonic
    monkeypatch.setattr(time, "time", lambda: right() + later_s[0] - behind_s[0])
    clock = SimpleNamespace(monotonic=lambda: running() + later_s[0], time=time.time)
    monkeypatch.setattr("service.sessions.clock.time", clock)
    async with serve(database_url=url, session_idle_s=day_s, audit_retention_s=7 * day_s) as served:
        store, sweep = served.gateway.store, served.gateway.sessions.sweep
        monkeypatch.setattr(store, "ahead_s", lambda: asyncio.sleep(0, 0.0))
        over, unused = [await served.open() for _ in range(2)]
        await served.ego(over).close()
        served.gateway.sessions._forget(unused.session_id)  # as if this process had just started
        behind_s[0] = 0
        for later_s[0], lines, ended in ((0.0, 2, False), (0.5 * day_s, 2, False), (2 * day_s, 2, True)):
            await sweep()
            assert len(await store.audit(over.session_id, 0)) == lines
            assert ((await store.get(unused.session_id)).ended_at is not None) is ended
        assert caplog.text.count("set forward by 630720000 s") == 1
        later_s[0] = 8.5 * day_s  # lines of a day go together
        await sweep()
        assert await store.audit(over.session_id, 0) == []
