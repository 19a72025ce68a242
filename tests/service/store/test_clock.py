"""A gateway whose clock is not the database's."""

import time

import pytest

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
        assert await store.audit(over.session_id, 0) == []
