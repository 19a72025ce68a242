"""What a dishonest gateway might write into a log, and what gives it away."""

import base64
import json

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from typer.testing import CliRunner

from robosac.answers import LogReceipt
from robosac.audit import Fault, Receipts, compact, digest, misbehaviour, verify
from robosac.audit.events import event_on
from robosac.audit.receipts import by_id
from robosac.cli import app
from robosac.signatures import key_id, show_public_key, sign_head
from tests.robosac.audit.conftest import KEY, SESSION, proof, seal_all
from tests.robosac.audit.test_misbehaviour import NOW

GATEWAY = Ed25519PrivateKey.from_private_bytes(bytes(31) + b"\x07")
PUBLIC = show_public_key(GATEWAY)


def written(events):
    """The lines of a log in this version's format."""
    return seal_all(compact(event_on(json.dumps(event).encode())) for event in events)


def faults(lines, receipts=None):
    return [(finding.line, finding.fault) for finding in verify(lines, receipts=receipts)]


def told(name, frame, what=""):
    return proof(name, frame, what).as_json()


def receipt(lines, seq, key=GATEWAY, session=SESSION):
    head = digest(lines[seq - 1].decode().removesuffix("\n"))
    signature = base64.b64encode(sign_head(key, session, seq, head)).decode()
    return LogReceipt(session=session, seq=seq, head=head, key_id=key_id(key.public_key()), signature=signature)


def kept(*receipts):
    return Receipts.read([each.model_dump_json().encode() for each in receipts], by_id([PUBLIC]))


def test_a_log_of_this_format_is_sound(events):
    assert verify(written(events)) == []


def test_two_honest_messages_of_different_frames_are_no_equivocation(events):
    events[4] = {**events[4], "first": told("rsu", 0), "second": told("rsu", 1)}
    assert faults(written(events)) == [(5, Fault.BAD_SIGNATURE)]
    events[4] = {**events[4], "first": told("rsu", 1), "second": told("rsu", 5)}
    assert faults(written(events)) == [(5, Fault.BAD_SIGNATURE)]


def test_a_first_message_that_nobody_signed_or_saw_is_no_evidence(events):
    events[4] = {**events[4], "first": {"digest": "ab" * 32}}
    assert faults(written(events)) == [(5, Fault.NO_EVIDENCE)]
    with pytest.raises(misbehaviour.NothingToReport):
        misbehaviour.report(written(events), "rsu", NOW)
    events[4] = {**events[4], "first": {"digest": told("rsu", 0)["digest"]}}  # seen, but in another frame
    assert Fault.NO_EVIDENCE in [fault for _, fault in faults(written(events))]


def test_of_a_vehicle_without_a_key_nothing_is_reported_that_the_gateway_alone_says(events):
    events[4] = {**events[4], "vehicle_id": "car-3", "first": told("car-3", 1), "second": told("car-3", 1, "!")}
    assert verify(written(events)) == []
    with pytest.raises(misbehaviour.NothingToReport):
        misbehaviour.report(written(events), "car-3", NOW)


def test_a_message_that_was_moved_to_another_frame_is_found(events):
    messages = {**events[2]["messages"], "rsu": events[1]["messages"]["rsu"]}
    assert faults(written([*events[:2], {**events[2], "messages": messages}, *events[3:]])) == [
        (3, Fault.BAD_SIGNATURE),
        (5, Fault.NO_EVIDENCE),
    ]


def test_what_a_log_says_of_its_own_format_makes_no_rule_laxer(events):
    invented = {**events[4], "first": {"digest": "ab" * 32}}
    assert faults(seal_all([*events[:4], invented, *events[5:]])) == [(5, Fault.NO_EVIDENCE)]
    content = told("rsu", 1, "!")["digest"]
    no_frame = KEY.sign(b"\n".join((b"robosac message v1", SESSION.encode(), content.encode())))
    second = {"digest": content, "signature": base64.b64encode(no_frame).decode()}
    assert faults(seal_all([*events[:4], {**events[4], "second": second}, *events[5:]])) == [(5, Fault.BAD_SIGNATURE)]


def test_records_of_two_formats_in_one_log_are_told(events):
    whole = [compact(event_on(json.dumps(event).encode())) for event in events]
    assert faults(seal_all([events[0], *whole[1:]])) == [(2, Fault.MALFORMED)]
    assert faults(seal_all([*whole[:4], events[4], *whole[5:]])) == [(5, Fault.MALFORMED), (6, Fault.MALFORMED)]


def test_a_vehicle_without_a_key_is_not_accused_by_what_passes_for_signatures(events):
    junk = [{"digest": letter * 64, "signature": base64.b64encode(bytes(64)).decode()} for letter in "ab"]
    events[4] = {**events[4], "vehicle_id": "car-3", "first": junk[0], "second": junk[1]}
    assert verify(written(events)) == []
    with pytest.raises(misbehaviour.NothingToReport):
        misbehaviour.report(written(events), "car-3", NOW)


def test_what_was_promised_is_found_in_the_log(events):
    lines = written(events)
    known = kept(*(receipt(lines, seq) for seq in (1, 3, 8)))
    assert (known.doubts, faults(lines, known)) == ([], [])


def test_a_log_cut_and_sealed_anew_breaks_what_was_promised(events):
    lines = written(events)
    promised = kept(receipt(lines, 3), receipt(lines, 7), receipt(lines, 8))
    assert verify(lines[:5]) == []  # alone it tells nothing
    assert [str(finding) for finding in verify(lines[:5], receipts=promised)] == [
        "line 5 (seq 5): broken-promise: the gateway signed a record 7, and 1 more after it; it is not in the log"
    ]
    anew = written([*events[:3], *events[5:]])
    assert verify(anew) == []
    assert faults(anew, promised) == [(6, Fault.BROKEN_PROMISE)]
    changed = written([*events[:2], {**events[2], "time": "2026-01-01T00:00:00.000Z"}, *events[3:]])
    assert verify(changed) == []
    assert faults(changed, promised) == [(line, Fault.BROKEN_PROMISE) for line in (3, 7, 8)]


def test_two_heads_for_one_record_convict_the_gateway(events):
    lines = written(events)
    other = written([*events[:2], {**events[2], "time": "2026-01-01T00:00:00.000Z"}, *events[3:]])
    (finding,) = verify(lines, receipts=kept(receipt(lines, 3), receipt(other, 3)))
    assert finding.fault is Fault.BROKEN_PROMISE
    assert "two heads of record 3" in finding.detail


def test_receipts_of_another_session_vouch_for_nothing(events):
    lines = written(events)
    assert faults(lines, kept(receipt(lines, 3, session="another"))) == [(8, Fault.BROKEN_PROMISE)]


def test_what_the_gateway_did_not_sign_is_not_used(events):
    lines = written(events)
    stranger = receipt(lines, 3, Ed25519PrivateKey.generate())
    good = receipt(lines, 3)
    forged = [
        stranger,
        stranger.model_copy(update={"key_id": good.key_id}),
        good.model_copy(update={"head": "0" * 64}),
        good.model_copy(update={"seq": 4}),
        good.model_copy(update={"signature": "?"}),
    ]
    known = Receipts.read([*(each.model_dump_json().encode() for each in forged), b"{}"], by_id([PUBLIC]))
    assert (len(known.doubts), known.heads) == (6, {})


def test_the_command_checks_receipts(events, tmp_path):
    lines = written(events)
    log, receipts = tmp_path / "log.jsonl", tmp_path / "receipts.jsonl"
    both = receipt(lines, 7), receipt(lines, 7, session="another's, of which nothing is checked")
    receipts.write_text("".join(each.model_dump_json() + "\n" for each in both))
    log.write_bytes(b"".join(lines))
    command = ["audit", "verify", str(log), "--receipts", str(receipts)]
    done = CliRunner().invoke(app, [*command, "--gateway-key", PUBLIC])
    assert (done.exit_code, "as 1 receipts promised" in done.output) == (0, True)
    log.write_bytes(b"".join(lines[:5]))
    done = CliRunner().invoke(app, [*command, "--gateway-key", PUBLIC])
    assert (done.exit_code, "broken-promise" in done.output) == (1, True)
    assert CliRunner().invoke(app, command).exit_code == 2
    done = CliRunner().invoke(app, [*command[:3], "--gateway-key", PUBLIC])
    assert (done.exit_code, "--receipts" in done.output) == (2, True)
    assert CliRunner().invoke(app, [*command, "--gateway-key", "A" * 43 + "="]).exit_code == 2
