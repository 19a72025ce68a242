"""A log that somebody with all of the gateway's rights has written anew, and what gives it away."""

from __future__ import annotations

import asyncio
import base64
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from clients.client import GatewayClient
from clients.hostile.attacker import BROKEN, Attacker, message_of
from robosac.audit import GENESIS, Fault, Receipts, digest, seal, verify
from robosac.audit.receipts import by_id
from robosac.signatures import show_public_key

EGO, MATE = "ego", "mate"
FRAMES = 6
NAMED = "named: "
Record = dict[str, Any]
Log = list[Record]
"""Records without their places in the chain."""


def _answer_changed(log: Log) -> Log:
    """A frame is told to have been decided under the suspicion of nobody."""
    _, at, *_ = _answers(log)
    return _with(log, at, {**log[at], "attacker_ratio": 0.0})


def _record_left_out(log: Log) -> Log:
    """That a token was renewed is not told."""
    return [record for record in log if record["event"] != "token_renewed"]


def _end_cut_off(log: Log) -> Log:
    """The log ends two frames earlier."""
    return log[: _answers(log)[-2]]


def _message_moved(log: Log) -> Log:
    """A teammate's message stands in another frame than it was sent for."""
    _, before, after, *_ = _answers(log)
    said = {**log[after]["messages"], MATE: log[before]["messages"][MATE]}
    return _with(log, after, {**log[after], "messages": said})


def _signature_taken_off(log: Log) -> Log:
    """A message of a vehicle that signs has no signature."""
    _, at, *_ = _answers(log)
    said = log[at]["messages"]
    return _with(log, at, {**log[at], "messages": {**said, MATE: said[MATE][0]}})


def _equivocation(log: Log) -> Log:
    """Two honest messages of different frames are told to be of one."""
    _, before, after, *_ = _answers(log)
    first, second = (_proof(*log[at]["messages"][MATE]) for at in (before, after))
    told = {name: log[after][name] for name in ("time", "format", "frame")}
    accused = {**told, "event": "equivocation", "vehicle_id": MATE, "first": first, "second": second}
    return [*log[: after + 1], accused, *log[after + 1 :]]


FORGERIES: dict[str, tuple[Callable[[Log], Log], Fault]] = {
    "a message moved to another frame": (_message_moved, Fault.BAD_SIGNATURE),
    "a signature taken off": (_signature_taken_off, Fault.BAD_SIGNATURE),
    "an equivocation of two honest messages": (_equivocation, Fault.BAD_SIGNATURE),
    "an answer changed": (_answer_changed, Fault.BROKEN_PROMISE),
    "a record left out": (_record_left_out, Fault.BROKEN_PROMISE),
    "the end cut off": (_end_cut_off, Fault.BROKEN_PROMISE),
}
"""What is done to a log before it is sealed anew, and what `verify` has to find."""


async def logs(attacker: Attacker) -> None:
    """Forge the log of a session in which all sign, and hold each against the receipts that its ego kept."""
    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        file = Path(folder) / "receipts.jsonl"
        async with GatewayClient(attacker.target.url, attacker.target.key, receipts=file) as gateway:
            true = await _played(attacker, gateway)
            kept = Receipts.read(file.read_bytes().splitlines(), by_id(await gateway.public_keys()))
    await asyncio.to_thread(hold, attacker.answers, true, kept)


def hold(answers: Counter[str], true: Sequence[bytes], kept: Receipts) -> None:
    """Count which forgeries of a true log `verify` names, and which it does not."""
    records = [json.loads(line) for line in true]
    sid = records[0]["session_id"]
    log = [{name: each[name] for name in each.keys() - {"session_id", "seq", "previous"}} for each in records]
    answers[(BROKEN if verify(true, receipts=kept) or kept.doubts else NAMED) + "the true log"] += 1
    edited = [*true[:-1], true[-1].replace(b'"frame":', b'"frame": ', 1)]
    found = {finding.fault for finding in verify(edited, receipts=kept)}
    answers[(NAMED if Fault.NOT_CANONICAL in found else BROKEN) + "a byte added"] += 1
    for what, (forge, fault) in FORGERIES.items():
        found = {finding.fault for finding in verify(_sealed(forge(log), sid), receipts=kept)}
        answers[(NAMED if fault in found else BROKEN) + what] += 1


async def _played(attacker: Attacker, gateway: GatewayClient) -> list[bytes]:
    """The log of a few frames of an ego and a teammate that both sign, and of a token between them."""
    keys = {name: Ed25519PrivateKey.generate() for name in (EGO, MATE)}
    public = {name: show_public_key(key) for name, key in keys.items()}
    opened = await gateway.open_session(EGO, [MATE], public_keys=public, latency_budget_ms=60_000.0)
    sid = opened.session_id
    ego = gateway.vehicle(sid, EGO, opened.ego_token, keys[EGO])
    mate = gateway.vehicle(sid, MATE, opened.teammate_tokens[MATE], keys[MATE])
    own, other = (
        message_of(each) for each in (attacker.frame["ego"], next(iter(attacker.frame["teammates"].values())))
    )
    for frame in range(FRAMES):
        signature = mate.signature(frame, other) or b""
        await ego.post_frame(frame, own, {MATE: other}, {MATE: signature})
        if frame == FRAMES // 2:
            await mate.renew()
    return [line.encode() for line in await ego.audit_lines()]


def _answers(log: Log) -> list[int]:
    return [at for at, record in enumerate(log) if record["event"] == "frame_answered"]


def _with(log: Log, at: int, record: Record) -> Log:
    return [*log[:at], record, *log[at + 1 :]]


def _proof(short: str, signature: str) -> Record:
    return {"digest": base64.urlsafe_b64decode(short + "=" * (-len(short) % 4)).hex(), "signature": signature}


def _sealed(log: Log, session_id: str) -> list[bytes]:
    lines: list[str] = []
    for seq, record in enumerate(log, 1):
        lines.append(seal(record, session_id, seq, digest(lines[-1]) if lines else GENESIS))
    return [line.encode() for line in lines]
