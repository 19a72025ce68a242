import asyncio
import contextlib
import json
import math
import subprocess
import sys
from collections import Counter

import httpx
import msgpack
import pytest
import typer
from typer.testing import CliRunner

from clients.adversary import RECOVERED_WITHIN, Result, Seen, main
from clients.hostile import BROKEN, STRANGERS, Attack, Target, forging, stolen, strange_frame
from clients.hostile.attacker import Attacker
from clients.hostile.forging import FORGERIES, NAMED
from clients.load_test import EGO, TEAM
from robosac import wire
from robosac.audit import Fault, Receipts
from robosac.session import Session


def test_attacks_are_played_and_told(tmp_path):
    """As a command, since its attacker is a process of its own."""
    attacks = [Attack.LONG, Attack.DATABASE, Attack.FORGED, Attack.DISK]
    only = [word for attack in attacks for word in ("--only", attack.value)]
    command = [sys.executable, "-m", "clients.adversary", "--seconds", "2", "--out", str(tmp_path), *only]
    command += ["--budget-ms", "1000", "--at-least", "0.8"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for attack in attacks:
        assert attack.value in done.stdout
    results = long, locked, forged, full = json.loads((tmp_path / "adversary.json").read_text())
    for part in (long["before"], long["during"], locked["before"], forged["during"]):
        assert part["frames"] == 10
        assert part["tested"] >= 8
    for faulty in (locked, full):
        assert faulty["during"]["frames"] == 10
        assert faulty["recovered_after"] <= RECOVERED_WITHIN
    assert sorted(forged["attacker"]) == sorted(
        f"{NAMED}{what}" for what in (*FORGERIES, "the true log", "a byte added")
    )
    for result in results:
        assert result["before"]["belied"] == result["during"]["belied"] == 0
        assert result["broken"] == []
        assert 50 < result["memory_mib"] < 4000


def test_a_teammate_attacks_from_within_the_session(tmp_path):
    command = [sys.executable, "-m", "clients.adversary", "--seconds", "2", "--budget-ms", "1000", "--at-least", "0.5"]
    only = ["--only", Attack.STREAMS.value, "--only", Attack.TOKENS.value]
    command += [*only, "--by", "teammate", "--out", str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "attacks by: teammate" in " ".join(done.stdout.split())
    streams, tokens = json.loads((tmp_path / "adversary.json").read_text())
    assert streams["attacker"]["200"] > 10
    assert set(tokens["attacker"]) >= {"201", "401"}  # renewed, and spoken with one that was replaced


def test_a_teammate_cannot_do_what_needs_a_key():
    options = ["--by", "teammate", "--only", Attack.MANY.value, "--only", Attack.SMALL.value]
    app = typer.Typer()
    app.command()(main)
    refused = CliRunner().invoke(app, options)
    assert refused.exit_code == 2
    assert "no teammate's attack: many sessions" in " ".join(refused.output.split())


async def test_whoever_has_a_key_is_a_teammate_in_a_session_of_its_own():
    def answer(request):
        assert json.loads(request.content)["teammates"] == ["mate"]
        return httpx.Response(201, json={"session_id": "own", "teammate_tokens": {"mate": "token"}})

    for teammate, expected in ((("rsu", "its token"), ("5e55", "rsu", "its token")), (None, ("own", "mate", "token"))):
        target = Target("http://gateway", "key", "", 0, b"", b"", "5e55", teammate=teammate)
        async with httpx.AsyncClient(base_url=target.url, transport=httpx.MockTransport(answer)) as http:
            assert await Attacker(http, target, Counter()).as_teammate() == expected


@pytest.mark.parametrize(
    ("belied", "recovered", "attack", "answers", "held"),
    [
        (0, 0, Attack.DATABASE, {}, True),
        (0, RECOVERED_WITHIN + 1, Attack.DATABASE, {}, False),
        (0, None, Attack.DISK, {}, False),
        (0, None, Attack.LONG, {"200": 1}, True),
        (1, 0, Attack.LONG, {}, False),
        (0, None, Attack.STOLEN, {"401": 3, f"{BROKEN}POST /token": 1}, False),
    ],
)
def test_what_does_not_hold_is_told(belied, recovered, attack, answers, held):
    during = Seen(200.0, frames=10, belied=belied)
    assert Result(attack, Seen(200.0), during, answers, math.nan, recovered).held is held


def test_frames_until_one_is_good_are_counted_in_the_order_in_which_they_were_due():
    seen = Seen(200.0, outcomes=[(1.0, True), (4.0, True), (2.0, False), (3.0, False)])
    assert [seen.recovered_after(moment) for moment in (0.5, 1.5, 4.0, 5.0)] == [0, 2, 0, None]


def test_whoever_measures_leaves_the_gateway_cores_of_its_own():
    said = "from clients.cores import Cores; import os, sys; cores = Cores(); all = os.sched_getaffinity(0)\n"
    said += "with cores.of_gateways(): theirs = os.sched_getaffinity(0)\n"
    said += "ours = os.sched_getaffinity(0)\n"
    said += "sys.exit(not (theirs | ours == all and (len(all) == 1 or not theirs & ours)))"
    assert subprocess.run([sys.executable, "-c", said], check=False).returncode == 0


def test_a_strange_frame_contradicts_the_ego_and_passes_what_is_looked_at_before(detector, messages):
    honest = wire.pack_frame(0, messages[EGO], {name: messages[name] for name in TEAM})
    frame = wire.read_frame(strange_frame(honest))
    team = {name: wire.check_message(payload, detector.info, "teammate") for name, payload in frame.teammates.items()}
    assert len(team) == STRANGERS
    assert frame.frame == msgpack.unpackb(honest)["frame"]
    answer = Session(detector, list(team)).answer(0, messages[EGO], team)
    assert len(answer.rejected) > STRANGERS // 2  # some may agree with the ego by chance
    assert answer.sampling_steps > 0


async def test_a_gateway_that_takes_stolen_tokens_is_told(messages):
    """One that says yes to all."""
    opened = {"session_id": "5e55", "ego_token": "a", "teammate_tokens": {"mate": "b"}, "teammates": []}
    body = wire.pack_frame(0, messages[EGO], {name: messages[name] for name in TEAM})
    target = Target("http://gateway", "", "", 0, b"", body)

    async def take(request):
        await asyncio.sleep(0.001)
        return httpx.Response(200, json=opened)

    answers = Counter()
    async with httpx.AsyncClient(base_url=target.url, transport=httpx.MockTransport(take)) as http:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(2.0):
                await stolen.tokens(Attacker(http, target, answers))
    broken = {told.removeprefix(BROKEN) for told in answers if told.startswith(BROKEN)}
    changes = {"POST /token", "POST /teammates", "DELETE /teammates/mate", "DELETE /", "POST /messages", "POST /frames"}
    assert {told.partition(" by ")[0] for told in broken} == {*changes, "another team"}


def test_forgeries_that_nobody_names_are_told(monkeypatch):
    lines = [json.dumps({"event": "frame_answered", "seq": 1, "session_id": "5e55", "frame": 0}).encode()]
    monkeypatch.setattr(forging, "verify", lambda lines, receipts: [])
    monkeypatch.setattr(forging, "FORGERIES", {"nothing": (lambda log: log, Fault.BROKEN_PROMISE)})
    answers = Counter()
    forging.hold(answers, lines, Receipts())
    assert set(answers) == {f"{NAMED}the true log", f"{BROKEN}a byte added", f"{BROKEN}nothing"}
