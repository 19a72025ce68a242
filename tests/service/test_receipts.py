"""The gateway's promises about its logs: signed with its own key, checked and kept by clients."""

import base64
import errno
import json
import os

import httpx
import pytest

from clients.client import GatewayClient
from clients.errors import ProtocolError
from robosac import wire
from robosac.audit import Receipts, verify
from robosac.audit.receipts import by_id, check_receipt
from service.keeping.gateway_keys import GatewayKeys
from tests.service.conftest import EGO, TEAM, problem, serve

ANOTHER = base64.b64encode(bytes(range(32))).decode()


async def test_every_answer_promises_the_log_that_it_is_in(messages, tmp_path):
    async with serve() as served:
        (key,) = (await served.http.get("/v1/keys")).json()["keys"]
        assert (key["signs"], len(base64.b64decode(key["public_key"]))) == (True, 32)
        transport, file = served.client._http._transport, tmp_path / "receipts.jsonl"
        trusted, to = [key["public_key"]], str(file)
        pinned = GatewayClient("http://gateway", transport=transport, gateway_keys=trusted, receipts=to)
        session = await pinned.open_session(EGO, TEAM, gather_ms=50, latency_budget_ms=20_000)
        ego = pinned.vehicle(session.session_id, EGO, session.ego_token)
        unit = pinned.vehicle(session.session_id, "rsu", session.teammate_tokens["rsu"])
        for frame in range(2):
            await unit.send(frame, messages["rsu"])
            answer = await ego.ask(frame, messages[EGO])
        lines = [line.encode() for line in await ego.audit_lines()]
        state = await ego.state()
        assert "receipt" not in await last(ego)
    assert (answer.receipt.seq, answer.receipt.head) == (3, state["audit_head"])
    assert pinned.receipts.latest(session.session_id) == answer.receipt
    assert (state["receipt"]["seq"], state["receipt"]["head"]) == (3, state["audit_head"])
    kept = Receipts.read(file.read_bytes().splitlines(), by_id([key["public_key"]]))
    assert (kept.doubts, sorted(kept.of(session.session_id))) == ([], [1, 2, 3])
    assert verify(lines, receipts=kept) == []
    assert [finding.fault for finding in verify(lines[:2], receipts=kept)] == ["broken-promise"]


async def test_whoever_changes_or_ends_a_session_is_promised_that_it_is_on_record(tmp_path):
    async with serve() as served:
        (key,) = await served.client.public_keys()
        transport, file = served.client._http._transport, tmp_path / "receipts.jsonl"
        pinned = GatewayClient("http://gateway", transport=transport, gateway_keys=[key], receipts=file)
        session = await pinned.open_session(EGO, TEAM)
        ego = pinned.vehicle(session.session_id, EGO, session.ego_token)
        for change in (ego.renew(), ego.enrol(["car-9"]), ego.dismiss("car-9")):
            before = pinned.receipts.latest(session.session_id).seq
            await change
            assert pinned.receipts.latest(session.session_id).seq == before + 1
        head = await ego.close()
        assert pinned.receipts.latest(session.session_id).head == head
        lines = [line.encode() for line in await ego.audit_lines()]
    kept = Receipts.read(file.read_bytes().splitlines(), by_id([key]))
    assert sorted(kept.of(session.session_id)) == [1, 2, 3, 4, 5]
    assert verify(lines, receipts=kept) == []
    assert [finding.fault for finding in verify(lines[:-1], receipts=kept)] == ["broken-promise"]


async def test_a_header_that_is_no_receipt_is_told():
    async with serve() as served:
        session, trusted = await served.open(), await served.client.public_keys()

        def client(headers):
            transport = httpx.MockTransport(lambda _: httpx.Response(204, headers=headers))
            pinned = GatewayClient("http://gateway", transport=transport, gateway_keys=trusted)
            return pinned.vehicle(session.session_id, EGO, "token")

        with pytest.raises(ProtocolError, match="Audit-Receipt is no receipt"):
            await client({"Audit-Receipt": "{}"}).dismiss("rsu")
        with pytest.raises(ProtocolError, match="the answer has no receipt"):
            await client({}).close()


async def last(ego):
    return (await ego.audit())[-1]


async def test_a_client_refuses_what_another_key_signed(good_frame):
    async with serve() as served, serve() as other:
        (wrong,) = await other.client.public_keys()
        transport = served.client._http._transport
        pinned = GatewayClient("http://gateway", transport=transport, gateway_keys=[wrong])
        with pytest.raises(ProtocolError, match="not known"):
            await pinned.open_session(EGO, TEAM)


async def test_a_client_refuses_a_changed_or_missing_receipt(good_frame):
    async with serve() as served:
        session = await served.open()
        (key,) = await served.client.public_keys()
        whole = (await served.post(session, "frames", good_frame(0))).json()

        def client(**changes):
            told = {**whole, "receipt": None if None in changes.values() else {**whole["receipt"], **changes}}
            transport = httpx.MockTransport(lambda _: httpx.Response(200, content=wire.pack(told)))
            pinned = GatewayClient("http://gateway", transport=transport, gateway_keys=[key])
            return pinned.vehicle(session.session_id, EGO, "token")

        assert (await client().post_frame_body(b"")).receipt.seq == 2
        for changes, why in (({"seq": 3}, "not the gateway's"), ({"seq": None}, "no receipt"),
                             ({"head": "0" * 64}, "not the gateway's"), ({"signature": "?"}, "base64")):  # fmt: skip
            with pytest.raises(ProtocolError, match=why):
                await client(**changes).post_frame_body(b"")


class Lying(httpx.AsyncBaseTransport):
    """A gateway that changes what it answers."""

    def __init__(self, transport):
        self._transport = transport
        self.change = lambda response: response

    async def handle_async_request(self, request):
        response = await self._transport.handle_async_request(request)
        await response.aread()
        return self.change(response)

    def answer(self, **fields):
        """Put these in the place of what bodies say."""

        def change(response):
            packed = "json" not in response.headers["content-type"]
            told = (wire.unpack(response.content, trusted=True) if packed else response.json()) | fields
            headers = {"content-type": response.headers["content-type"]}
            content = wire.pack(told) if packed else json.dumps(told).encode()
            return httpx.Response(response.status_code, headers=headers, content=content)

        self.change = change


@pytest.fixture
async def lied_to(tmp_path):
    """A gateway that lies, and an ego that pins its key."""
    async with serve() as served:
        lying, keys = Lying(served.client._http._transport), await served.client.public_keys()
        file = tmp_path / "receipts.jsonl"
        client = GatewayClient("http://gateway", transport=lying, gateway_keys=keys, receipts=file)
        session = await client.open_session(EGO, TEAM, gather_ms=50, latency_budget_ms=20_000)
        yield lying, client.vehicle(session.session_id, EGO, session.ego_token), session, file


async def test_a_receipt_that_was_given_before_promises_nothing_new(lied_to, good_frame):
    lying, ego, session, _ = lied_to
    old = (await ego.post_frame_body(good_frame(0))).receipt
    for receipt in (session.receipt, old):
        why = f"of record {receipt.seq}, and record 2 was promised before"
        lying.answer(receipt=receipt.model_dump())
        for ask in (ego.renew, lambda name=f"car-{receipt.seq}9": ego.enrol([name])):
            with pytest.raises(ProtocolError, match=why):
                await ask()
        with pytest.raises(ProtocolError, match=why):
            await ego.post_frame_body(good_frame(receipt.seq))
    lying.change = lambda _: httpx.Response(204, headers={"Audit-Receipt": old.model_dump_json()})
    with pytest.raises(ProtocolError, match="of record 2, and record 2 was promised before"):
        await ego.dismiss("rsu")


async def test_an_end_of_the_log_that_is_not_the_promised_one_is_told(lied_to):
    lying, ego, session, file = lied_to
    state = await ego.state()
    assert file.read_text().splitlines() == [session.receipt.model_dump_json()] * 2
    for wrong, why in (({"audit_head": "0" * 64}, "not of the end"), ({"audit_seq": 2}, "not of the end"),
                       ({"receipt": None}, "no receipt"), ({"receipt": {}}, "is none"),
                       ({"receipt": {**state["receipt"], "signature": "AAAA"}}, "proves nothing")):  # fmt: skip
        lying.answer(**wrong)
        with pytest.raises(ProtocolError, match=why):
            await ego.state()


@pytest.mark.parametrize(("head", "why"), [("0" * 64, "promises"), (None, "has no Audit-Head")])
async def test_a_head_that_was_not_promised_is_told_when_a_session_ends(lied_to, head, why):
    lying, ego, *_ = lied_to

    def change(response):
        headers = {"Audit-Receipt": response.headers["audit-receipt"], **({} if head is None else {"Audit-Head": head})}
        return httpx.Response(204, headers=headers)

    lying.change = change
    with pytest.raises(ProtocolError, match=why):
        await ego.close()


async def test_keys_are_rotated_with_overlap(tmp_path, good_frame):
    file, url = tmp_path / "gateway.key", f"sqlite:///{tmp_path}/robosac.db"
    async with serve(database_url=url, gateway_key_file=file) as served:
        session = await served.open()
        old = (await served.ego(session).post_frame_body(good_frame(0))).receipt
    assert file.stat().st_mode & 0o777 == 0o600
    file.write_text(ANOTHER + "\n" + file.read_text())
    async with serve(database_url=url, gateway_key_file=file) as served:
        keys = by_id(await served.client.public_keys())
        new = (await served.ego(session).post_frame_body(good_frame(1))).receipt
        for receipt in (old, new):
            check_receipt(receipt, keys)
        published = (await served.http.get("/v1/keys")).json()["keys"]
    assert [(key["key_id"], key["signs"]) for key in published] == [(new.key_id, True), (old.key_id, False)]


async def test_the_key_outlives_the_process(tmp_path):
    ids = []
    for _ in range(2):
        async with serve(database_url=f"sqlite:///{tmp_path}/robosac.db") as served:
            ids += await served.client.public_keys()
    assert ids[0] == ids[1]


@pytest.mark.parametrize(
    ("text", "mode", "why"),
    [
        ("", 0o600, "no key"),
        (f"{ANOTHER}\n\nAAAA", 0o600, "line 3 is no Ed25519"),
        (ANOTHER, 0o640, "others may read"),
    ],
)
async def test_a_bad_key_file_is_refused(tmp_path, text, mode, why):
    file = tmp_path / "gateway.key"
    file.write_text(text)
    file.chmod(mode)
    with pytest.raises(ValueError, match=why):
        await GatewayKeys(file).start(None)


@pytest.mark.parametrize(("mode", "taken"), [(0o440, True), (0o640, True), (0o660, False), (0o444, False)])
async def test_a_key_file_of_somebody_else_may_be_read_by_its_group(tmp_path, monkeypatch, mode, taken):
    """As a secret of Kubernetes is, which nobody but root owns."""
    file = tmp_path / "gateway.key"
    file.write_text(ANOTHER)
    file.chmod(mode)
    monkeypatch.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
    keys = GatewayKeys(file)
    if taken:
        await keys.start(None)
        assert len(keys.published()) == 1
    else:
        with pytest.raises(ValueError, match="others may read"):
            await keys.start(None)


async def test_a_key_file_is_made_whole_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "gateway.key"

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(ValueError, match="cannot be read"):
            await GatewayKeys(file).start(None)
    assert list(tmp_path.iterdir()) == []
    keys = GatewayKeys(file)
    with monkeypatch.context() as patched:  # another process makes it at the same time
        patched.setattr(os, "fsync", lambda _: file.write_text(ANOTHER) and file.chmod(0o600))
        await keys.start(None)
    assert file.read_text() == ANOTHER
    assert [path.name for path in tmp_path.iterdir()] == ["gateway.key"]


async def test_a_torn_receipt_costs_no_other_one(messages, tmp_path):
    async with serve() as served:
        file = tmp_path / "receipts.jsonl"
        client = GatewayClient("http://gateway", transport=served.client._http._transport, receipts=file)
        session = await client.open_session(EGO, TEAM, gather_ms=20)
        whole = file.read_bytes()
        file.write_bytes(whole + whole[:40])
        ego = client.vehicle(session.session_id, EGO, session.ego_token)
        await ego.ask(0, messages[EGO])
        kept = Receipts.read(file.read_bytes().splitlines(), by_id(await client.public_keys()))
    assert (len(kept.doubts), sorted(kept.of(session.session_id))) == (1, [1, 2])


async def test_answers_with_tokens_are_not_stored(served):
    body = {"ego_id": EGO, "teammates": list(TEAM)}
    opened = await served.http.post("/v1/sessions", json=body)
    path = f"/v1/sessions/{opened.json()['session_id']}"
    bearer = {"Authorization": f"Bearer {opened.json()['ego_token']}"}
    joined = await served.http.post(f"{path}/teammates", json={"teammates": ["late"]}, headers=bearer)
    renewed = await served.http.post(f"{path}/token", headers=bearer)
    for response in (opened, joined, renewed):
        assert (response.status_code, response.headers["cache-control"]) == (201, "no-store")


async def test_a_full_log_refuses_frames_before_they_are_computed(hooked, good_frame):
    hooked.gateway.store._most_records = 2
    session = await hooked.open()
    await hooked.ego(session).post_frame_body(good_frame(0))
    computed = []
    type(hooked.detector).before_prepare = staticmethod(lambda *_: computed.append(1))
    try:
        fields = problem(await hooked.post(session, "frames", good_frame(1)), 507, "audit-full")
    finally:
        type(hooked.detector).before_prepare = None
    assert ("ROBOSAC_AUDIT_MAX_RECORDS" in fields["detail"], computed) == (True, [])
    assert json.loads((await hooked.ego(session).audit_lines())[-1])["frame"] == 0
    await hooked.ego(session).close()
