"""A database has to keep whatever a vehicle may send."""

import pytest

from robosac import wire
from tests.service.conftest import serve


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
