"""PostgreSQL as others have set it up: a gateway brings what it needs, or says what it lacks."""

import pytest
from sqlalchemy import make_url

from robosac import wire
from tests.service.conftest import serve
from tests.service.store.conftest import added, all_of, check_chain, note, opened


@pytest.mark.parametrize(("encoding", "taken"), [("UTF8", True), ("SQL_ASCII", True), ("LATIN1", False)])
async def test_a_database_that_could_not_keep_what_a_vehicle_sends_is_refused(encoding, taken, postgres, good_frame):
    url = await postgres.new_database(f"TEMPLATE template0 ENCODING '{encoding}' LOCALE 'C'")
    if not taken:
        with pytest.raises(ValueError, match=f"encoding is {encoding}"):
            async with serve(database_url=url):
                pass
        return
    async with serve(database_url=url) as served:
        session = await served.open()
        frame = wire.unpack(good_frame(0))
        frame["teammates"]["car-2"]["tensors"]["☃"] = b""
        assert (await served.post(session, "frames", wire.pack(frame))).status_code == 200
        assert "☃" in (await served.ego(session).audit_lines())[-1]


@pytest.mark.parametrize("level", ["serializable", "repeatable read"])
async def test_what_is_written_at_once_does_not_fail_where_transactions_are_isolated_more(level, postgres):
    url = await postgres.new_database()
    await postgres.do(f"ALTER DATABASE {make_url(url).database} SET default_transaction_isolation = '{level}'")
    async with opened(url) as one, opened(url) as other:
        sid = await added(one)
        assert set(await all_of(*(store.log(sid, note()) for _ in range(10) for store in (one, other)))) == {None}
        assert len(await check_chain(one, sid)) == 21
