"""How much of a session's log others than its ego may fill."""

from collections import Counter

import pytest

from clients.errors import FrameConflict
from robosac.audit import verify
from service.errors import ShareFull
from service.keeping.shares import AT_FIRST, PART, Shares
from tests.service.conftest import EGO, serve
from tests.service.store.conftest import a_session


async def refused(served, session, times=16):
    """As often a teammate is refused, and a stranger."""
    for _ in range(times):
        await served.post(session, "messages", b"junk", session.teammate_tokens["rsu"])
        await served.post(session, "messages", b"junk", "x")


async def test_refusals_fill_a_small_part_of_a_log_at_all_gateways_and_after_a_start(tmp_path, messages, benign):
    where = {"database_url": f"sqlite:///{tmp_path}/robosac.db", "audit_max_records": 2 * PART}
    async with serve(**where) as one, serve(**where) as other:
        session = await one.open(defense={"kind": "none"}, gather_ms=20)
        for frame, served in enumerate((one, other)):
            await refused(one, session)
            await refused(other, session)
            await served.ego(session).post_frame(frame, messages[EGO], benign)
    async with serve(**where) as again:
        ego, rsu = again.ego(session), again.teammate(session, "rsu")
        await refused(again, session)
        await rsu.send(2, messages["rsu"])
        with pytest.raises(FrameConflict, match="equivocation"):
            await rsu.send(2, messages["car-2"])
        await ego.ask(2, messages[EGO])
        records = await ego.audit()
        assert verify([line.encode() for line in await ego.audit_lines()]) == []
    events = Counter(record["event"] for record in records)
    assert events == {
        "session_opened": 1, "frame_answered": 3, "message_refused": 1, "access_refused": 1, "equivocation": 1,
    }  # fmt: skip
    told = [record["unlogged_refusals"] for record in records if record["event"] == "frame_answered"]
    assert told == [{"rsu": 15, "?": 15}, {"rsu": 32, "?": 32}, {"rsu": 16, "?": 16}]


@pytest.mark.parametrize("most_records", [None, 100, 50_000])
def test_others_than_the_ego_fill_less_than_a_tenth_of_a_log(most_records):
    shares, frames, others = Shares(most_records), 0, 0
    while frames + others < (most_records or 100_000):
        now = a_session(audit_seq=1 + frames + others, revision=frames, frames_answered=frames)
        try:
            shares.check_equivocation(now)
            others += 1
        except ShareFull:
            frames += 1
    assert others < 0.1 * (frames + others)
    assert others > 0.03 * frames - 1


def test_refusals_leave_room_for_what_proves_a_lie():
    now = a_session(audit_seq=1 + AT_FIRST, revision=0)
    with pytest.raises(ShareFull):
        Shares().check_refusal(now)
    Shares().check_equivocation(now)
