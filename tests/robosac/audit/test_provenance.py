"""On whose word boxes stand, from a defence over the wire into the log, and made again from it."""

import asyncio

import pytest

from robosac.answers import Standing
from robosac.audit import replay, verify
from robosac.defenses import Kinds, shipped
from tests.robosac.audit.conftest import seal_all, unpacked
from tests.robosac.judging import Judging
from tests.service.conftest import EGO, TEAM, serve

KINDS: Kinds = {**shipped(), "judging": Judging}


async def drive(ego_message, benign):
    async with serve(iter(range(40, 60)), keep_frames=9, extra_defenses="tests.robosac.judging:build") as served:
        session = await served.open(defense={"kind": "judging"})
        ego = served.ego(session)
        answers = [await ego.post_frame(number, ego_message, benign) for number in range(2)]
        lines = [line.encode() for line in await ego.audit_lines()]
        return answers, lines, await ego.kept_messages(1), (await ego.state())["audit_head"]


@pytest.fixture(scope="module")
def got(detector, ego_message, benign):
    return asyncio.run(drive(ego_message, benign))


def test_an_answer_says_on_whose_word_each_box_stands(got):
    for answer in got[0]:
        assert len(answer.support) == len(answer.boxes) > 0
        by_status = {support.status: support for support in answer.support}
        assert by_status[Standing.CONFIRMED].witnesses == (EGO, TEAM[0])
        assert by_status[Standing.SINGLE_WITNESS].witnesses == (TEAM[0],)
        assert by_status[Standing.REPAIRED].deniers == ()
        assert {box.deniers for box in answer.contradicted} == {(EGO, TEAM[1])}
        assert all(box.box[5] < 0.3 for box in answer.contradicted)
        assert min(answer.boxes[:, 5]) >= 0.3


def test_the_log_keeps_it_and_a_replay_compares_it(got, detector):
    answers, lines, body, head = got
    assert verify(lines, head) == []
    logged = unpacked(lines[2])
    assert logged["support"] == answers[1].as_json()["support"]
    told = answers[1].as_json()["contradicted"]
    for kept, one in zip(logged["contradicted"], told, strict=True):
        assert kept["box"] == pytest.approx(one["box"], abs=0.0051)
        assert {**kept, "box": one["box"]} == one
    assert replay.replay(replay.find(lines, 1), body, detector, KINDS) == []


@pytest.mark.parametrize("kind", ["judging", "group_testing"])
async def test_witnesses_stand_by_name_whatever_the_ego_is_called(kind, detector, ego_message, benign):
    renamed = dict(zip(("Rsu", "car-2", "Z"), benign.values(), strict=False))
    async with serve(iter(range(40, 60)), keep_frames=9, extra_defenses="tests.robosac.judging:build") as served:
        options = {"defense": {"kind": kind}, "latency_budget_ms": 20_000}
        session = await served.client.open_session("ego", list(renamed), **options)
        ego = served.client.vehicle(session.session_id, "ego", session.ego_token)
        answers = [await ego.post_frame(number, ego_message, renamed) for number in range(2)]
        lines, body = [line.encode() for line in await ego.audit_lines()], await ego.kept_messages(1)
        told = [support for answer in answers for support in (*answer.support, *answer.contradicted)]
        assert any("ego" in support.witnesses[1:] for support in told)
        for support in told:
            assert list(support.witnesses) == sorted(support.witnesses)
            assert list(support.deniers) == sorted(support.deniers)
        assert unpacked(lines[2])["support"] == answers[1].as_json()["support"]
        assert replay.replay(replay.find(lines, 1), body, detector, KINDS) == []


def changed(lines, index=2, **fields):
    """The log of a gateway that lied about a record, and chained it properly; what is None is not in it."""
    records = [unpacked(line) for line in lines]
    records[index] = {name: value for name, value in {**records[index], **fields}.items() if value is not ...}
    return seal_all(records, records[0]["session_id"])


def test_what_a_gateway_lies_about_it_comes_out_otherwise(got, detector):
    _, lines, body, _ = got
    logged = unpacked(lines[2])
    first, *rest = logged["support"]
    out, *others = logged["contradicted"]
    moved = {**out, "box": [out["box"][0] + 1e-5, *out["box"][1:]]}
    lies = [
        ({"support": [{**first, "status": "confirmed"}, *rest]}, "support"),
        ({"support": [{**first, "witnesses": []}, *rest]}, "support"),
        ({"support": [{**first, "deniers": ["rsu"]}, *rest]}, "support"),
        ({"support": None}, "support"),
        ({"contradicted": None}, "contradicted"),
        ({"contradicted": others}, "contradicted"),
        ({"contradicted": [moved, *others]}, "contradicted"),
        ({"contradicted": [{**out, "status": "disputed"}, *others]}, "contradicted"),
    ]
    for fields, what in lies:
        again = replay.find(changed(lines, **fields), 1)
        assert {difference.what for difference in replay.replay(again, body, detector, KINDS)} == {what}, fields
    exact = got[0][1].as_json()["contradicted"]  # as format 1 kept it
    near = {**exact[0], "box": [exact[0]["box"][0] + 1e-7, *exact[0]["box"][1:]]}
    again = replay.find(changed(lines, contradicted=[near, *exact[1:]]), 1)
    assert replay.replay(again, body, detector, KINDS) == []


def test_a_log_of_an_older_version_is_not_asked_for_it(got, detector):
    _, lines, body, _ = got
    older = changed(lines, support=..., contradicted=...)
    assert b'"support"' not in older[2]
    assert verify(older) == []
    assert replay.replay(replay.find(older, 1), body, detector, KINDS) == []


@pytest.mark.parametrize("field", ["support", "contradicted"])
@pytest.mark.parametrize("role", ["witnesses", "deniers"])
def test_the_word_of_somebody_without_a_message_is_found(got, field, role):
    lines = got[1]
    first, *rest = unpacked(lines[2])[field]
    findings = verify(changed(lines, **{field: [{**first, role: ["stranger"]}, *rest]}))
    assert [(finding.line, finding.fault.value) for finding in findings] == [(3, "contradiction")]
    assert "on the word of stranger" in findings[0].detail
