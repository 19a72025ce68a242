import asyncio
import io
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from contextlib import nullcontext
from types import ModuleType, SimpleNamespace
from typing import Literal

import httpx
import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from typer.testing import CliRunner

from clients.client import GatewayClient, OpenedSession
from clients.demo import main as demo_main
from clients.errors import FrameConflict, GatewayUnavailable, GatewayUnreachable
from clients.fleet import FleetOptions, _asked, _patiently, _Vehicle, close_run, main, run_fleet
from clients.local_gateway import GatewayProcess, local_gateway
from clients.simulation import Fleet
from clients.summary import FleetSummary
from robosac import wire
from robosac.answers import Distrust, Reason, RejectedTeammate
from robosac.attacks import PGD, load_campaign
from robosac.defenses.halving import Halving
from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS
from robosac.fusion import fuse
from robosac.scenes import IntersectionScene
from tests.few import Few


def options(url, **changes):
    defense = {"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3}
    values = {"url": url, "scenes": 1, "frames": 3, "first_scene": 3, "defense": defense, "budget_ms": 20_000.0}
    return FleetOptions(**{**values, **changes})


async def test_a_fleet_of_independent_clients_end_to_end(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_GATHER_MS", "10000")  # a busy machine does not decide who is heard
    console = Console(file=io.StringIO(), width=100)
    async with local_gateway(tmp_path / "gateway.log") as url:
        chosen = options(url, scenes=2, frames=3, egos=2, report=tmp_path / "report", packing=wire.Packing("int8"))
        summary = await run_fleet(chosen, console)
    close_run(chosen, summary, console)
    assert summary.frames == 2 * 3 * 2
    assert summary.clean_share >= 0.9
    report = json.loads((tmp_path / "report" / "summary.json").read_text())
    ap = {name: values["ap50"] for name, values in report["average_precision"].items()}
    assert ap["all benign"] >= ap["gateway"] > ap["ego only"] > ap["no defence"]
    assert report["settings"]["attackers"] == 1
    tally = report["participation"]
    assert sum(tally["attackers"].values()) == 12
    assert sum(tally["honest"].values()) == 12 * 4
    assert report["sampling_steps"]["mean"] >= 1
    assert report["latency_ms"]["p50"] <= report["latency_ms"]["p99"]
    assert imread(tmp_path / "report" / "example.png").std() > 0.01
    text = console.file.getvalue()
    for expected in ("what the gateway answered", "No attacker accepted in", "dissensus", "Latency over HTTP"):
        assert expected in text
    assert "in time by the gateway's clock" in " ".join(text.split())


def test_attackers_are_never_the_ego_and_send_each_ego_its_own(detector):
    for seed in range(5):
        fleet = Fleet(IntersectionScene(3), detector, 2, 2, PGD(steps=2), seed)
        assert not fleet.attackers & set(fleet.egos)
        first, second = fleet.sense(0)
        for attacker in fleet.attackers:
            sent = first.sent[attacker].tensors["features"]
            assert not np.array_equal(sent, first.benign[attacker].tensors["features"])
            assert not np.array_equal(sent, second.sent[attacker].tensors["features"])
        for honest in set(first.sent) - fleet.attackers:
            assert first.sent[honest] is first.benign[honest]
        assert second.ego_id in first.sent


def test_a_fleet_follows_a_campaign(detector):
    fleet = Fleet(IntersectionScene(3), detector, 1, 1, load_campaign("noise@asleep"), seed=0)
    struck = [fleet.sense(index)[0].attackers for index in (0, 9, 10)]
    assert struck == [frozenset(), frozenset(), fleet.attackers]
    assert len(fleet.attackers) == 1


@pytest.mark.parametrize(("egos", "attackers"), [(0, 1), (6, 0), (1, 6), (1, -1)])
def test_impossible_fleets_are_refused(detector, egos, attackers):
    with pytest.raises(ValueError, match="must be between"):
        Fleet(IntersectionScene(3), detector, egos, attackers, PGD(), 0)


@pytest.mark.parametrize(("lost", "told"), [(0, "few: the egos are in none of the frames"), (3, "the database took")])
async def test_a_run_without_an_answer_says_why(lost, told, monkeypatch):
    async def run_scene(options, fleet, summary, screen):
        summary.lost += lost

    monkeypatch.setattr("clients.fleet._run_scene", run_scene)
    with pytest.raises((ValueError, GatewayUnreachable), match=told):
        await run_fleet(options("http://127.0.0.1:9", data="tests.few:Few", attackers=0), Console(file=io.StringIO()))


def test_an_attack_that_nobody_makes_needs_nothing(detector, monkeypatch):
    bare = SimpleNamespace(info=detector.info, encode=detector.encode, prepare=detector.prepare)
    monkeypatch.setattr("clients.fleet.load_detector", lambda name: bare)
    monkeypatch.setattr("clients.fleet.detectors.load", lambda name: bare)
    words = ["--data", "tests.few:Few", "--url", "http://127.0.0.1:9"]
    attacked, honest = (CliRunner().invoke(command(main), [*words, "--attackers", number]) for number in "10")
    assert attacked.exit_code == 2
    assert "attack_surface" in attacked.output
    assert honest.exit_code == 1, honest.output
    assert "The fleet stopped" in honest.output
    assert "attack_surface" not in honest.output


class Odd(Few):
    def scenes(self, split):
        return [SimpleNamespace(number=0, length=None, agents=("car-1", "-1"), egos=("car-1",))]


def test_a_vehicle_that_no_gateway_takes_is_told_by_its_name():
    asked = CliRunner().invoke(command(main), ["--data", f"{__name__}:Odd", "--scenes", "1"], env={"COLUMNS": "200"})
    assert asked.exit_code == 2
    said = " ".join(asked.output.replace("│", " ").split())
    assert "few, scene 0: a gateway takes no vehicle '-1'; an id must match" in said


def command(function):
    import typer

    app = typer.Typer()
    app.command()(function)
    return app


def test_a_fleet_without_a_gateway_says_so():
    result = CliRunner().invoke(command(main), ["--url", "http://127.0.0.1:9", "--frames", "1", "--scenes", "1"])
    assert result.exit_code == 1
    assert "The fleet stopped" in result.output


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("--attack", "give one of bim"),
        ("--detector", "give one of"),
        ("--defense", "give one of a2cp, "),
        ("--dtype", "intersection-mean takes int8, not nonesuch"),
    ],
)
def test_an_unknown_attack_detector_or_defence_is_explained(option, complaint):
    result = CliRunner().invoke(command(main), [option, "nonesuch"])
    assert result.exit_code == 2
    assert complaint in result.output


@pytest.mark.parametrize(
    ("asked", "complaint"),
    [
        (["--attacker-ratio", "0.2"], "need to know the kind"),
        (["--defense", "halving", "--attacker-ratio", "0.2"], "halving: attacker_ratio"),
        (["--defense", "static_team", "--attacker-ratio", "2"], "less than 1"),
    ],
)
def test_settings_that_a_defence_does_not_take_are_refused_before_anything_is_sent(asked, complaint):
    result = CliRunner().invoke(command(main), asked)
    assert result.exit_code == 2
    assert complaint in result.output


def test_a_fleet_asks_for_a_defence_of_ones_own_by_its_kind(monkeypatch):
    class Own(Halving):
        kind: Literal["own"] = "own"

    module = ModuleType("own")
    module.build = lambda: Own(consensus_threshold=0.4)
    monkeypatch.setitem(sys.modules, "own", module)
    assert _asked("own:build", {}) == {"kind": "own", "consensus_threshold": 0.4}
    assert _asked("static_team", {"collaborators": 2}) == {"kind": "static_team", "collaborators": 2}
    assert _asked(None, {}) is None


async def test_a_run_that_ends_early_leaves_no_session_open(tmp_path, monkeypatch):
    console = Console(file=io.StringIO())

    async def fails(*_):
        raise GatewayUnreachable("gone for a moment")

    async with local_gateway(tmp_path / "gateway.log", settings={"ROBOSAC_MAX_SESSIONS": "2"}) as url:
        with monkeypatch.context() as patched:
            patched.setattr("clients.fleet._exchange", fails)
            for _ in range(2):
                with pytest.raises(GatewayUnreachable, match="for a moment"):
                    await run_fleet(options(url, egos=2, frames=1), console)
        assert (await run_fleet(options(url, egos=2, frames=1), console)).frames == 2


async def test_nobody_waits_as_long_as_a_stranger_says():
    async def busy():
        raise GatewayUnavailable(503, "about:blank", "maintenance", retry_after_s=86_400.0)

    with pytest.raises(GatewayUnavailable, match="maintenance"):
        await asyncio.wait_for(_patiently(busy, Counter()), 5)


def test_the_report_is_written_though_nobody_reads_the_summary(tmp_path):
    written = []

    def gone(_):
        raise BrokenPipeError

    summary = SimpleNamespace(print=gone, write=lambda folder, _: written.append(folder))
    with pytest.raises(BrokenPipeError):
        close_run(options("http://gateway", report=tmp_path), summary, Console(file=io.StringIO()))
    assert written == [tmp_path]


async def test_a_fleet_with_other_weights_than_the_gateway_stops(tmp_path):
    async with local_gateway(tmp_path / "gateway.log") as url:
        with pytest.raises(ValueError, match="other weights"):
            await run_fleet(options(url, detector=str(ADVERSARIAL_WEIGHTS)), Console(file=io.StringIO()))


def test_the_demo_shows_a_summary(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_API_KEYS", "not-for-the-gateway-of-the-demo")
    monkeypatch.setenv("ROBOSAC_LATENCY_BUDGET_MS", "20000")  # a busy machine does not decide what is shown
    monkeypatch.setenv("ROBOSAC_GATHER_MS", "10000")
    result = CliRunner().invoke(command(demo_main), ["--report", str(tmp_path), "--scenes", "1", "--frames", "6"])
    assert result.exit_code == 0, result.output
    assert "Watch it live: http://127.0.0.1:" in result.output
    assert "No attacker accepted in" in result.output
    assert "Named as attackers: 1 of 1" in result.output
    assert "Defence: group_testing, expecting positions to be wrong by 0.2 m." in result.output
    written = json.loads((tmp_path / "summary.json").read_text())
    assert written["settings"]["defense"] is None
    assert written["defense"]["pose_error_m"] == 0.2
    naming = written["naming"]
    assert (naming["attackers_named"], naming["honest_named"]) == (1, 0)
    assert (tmp_path / "example.png").exists()


def test_a_demo_to_be_watched_drives_on_until_it_is_interrupted(tmp_path):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
    command = [sys.executable, "-m", "clients.demo", "--report", str(tmp_path), "--scenes", "1", "--frames", "1"]
    with subprocess.Popen(
        [*command, "--watch"], stdout=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"}
    ) as demo:
        told = ""
        while "until Ctrl-C" not in told:
            told += (line := demo.stdout.readline())
            assert line, told
        demo.send_signal(signal.SIGINT)
        assert demo.wait(20) == 0
    assert "No attacker accepted in" in told
    assert (tmp_path / "summary.json").exists()


def test_the_demo_fails_loudly_when_the_gateway_does(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_GATHER_MS", "nonsense")
    result = CliRunner().invoke(command(demo_main), ["--report", str(tmp_path)])
    assert result.exit_code == 1
    assert "The demo stopped" in result.output
    assert "Error: ROBOSAC_GATHER_MS: Input should be a valid number" in " ".join(result.output.split())


async def test_a_gateway_that_does_not_start_shows_its_log(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_TORCH_THREADS", "0")
    with pytest.raises(GatewayUnreachable, match="ROBOSAC_TORCH_THREADS"):
        async with local_gateway(tmp_path / "gateway.log"):
            pytest.fail("it started")


@pytest.mark.parametrize(("slug", "raised"), [("stale-frame", False), ("equivocation", True)])
async def test_a_teammate_that_is_too_late_goes_on(slug, raised, ego_message):
    problem = {"type": f"urn:robosac:problem:{slug}", "detail": "it said so", "field": "frame"}
    transport = httpx.MockTransport(lambda _: httpx.Response(409, json=problem))
    vehicle = _Vehicle("rsu", GatewayClient("http://gateway", transport=transport), options("http://gateway"))
    vehicle.enrol("car-1", OpenedSession("s", "e", {"rsu": "t"}, "", {}, {}))
    frame = SimpleNamespace(ego_id="car-1", sent={"rsu": ego_message})
    with pytest.raises(FrameConflict) if raised else nullcontext():
        await vehicle.send(frame, 0)


@pytest.mark.parametrize(("refusals", "retry_after", "asked"), [(2, "0", 3), (9, "0", 5), (9, None, 1)])
async def test_a_gateway_that_is_slow_for_a_while_is_asked_again(refusals, retry_after, asked, ego_message):
    """A busy machine, whose disk takes longer over a decision than its frame has, ends no demo."""
    problem = {"type": "urn:robosac:problem:store-too-slow", "detail": "it said so"}
    headers = {} if retry_after is None else {"Retry-After": retry_after}
    requests = []

    def answer(request):
        requests.append(request)
        return httpx.Response(503, json=problem, headers=headers) if len(requests) <= refusals else receipt

    receipt = httpx.Response(202, content=wire.pack({"frame": 0, "vehicle_id": "rsu", "status": "accepted"}))
    vehicle = _Vehicle(
        "rsu", GatewayClient("http://gateway", transport=httpx.MockTransport(answer)), options("http://gateway")
    )
    vehicle.enrol("car-1", OpenedSession("s", "e", {"rsu": "t"}, "", {}, {}))
    frame = SimpleNamespace(ego_id="car-1", sent={"rsu": ego_message})
    with nullcontext() if asked > refusals else pytest.raises(GatewayUnavailable):
        await vehicle.send(frame, 0)
    assert len(requests) == asked
    assert vehicle.refused == ({"store-too-slow": asked - 1} if asked > 1 else {})


@pytest.mark.parametrize(("first", "raised"), [(503, False), (409, True)])
async def test_an_answer_that_is_lost_ends_no_fleet(first, raised, ego_message):
    """The database was writing when the frame's time was over, so the gateway could not say what would come of it."""
    slow = httpx.Response(503, json={"type": "urn:robosac:problem:store-too-slow"}, headers={"Retry-After": "0"})
    stale = httpx.Response(409, json={"type": "urn:robosac:problem:stale-frame"})
    answers = [slow, stale] if first == 503 else [stale]
    transport = httpx.MockTransport(lambda _: answers.pop(0))
    ego = _Vehicle("car-1", GatewayClient("http://gateway", transport=transport), options("http://gateway"))
    ego.enrol("car-1", OpenedSession("s", "e", {}, "", {}, {}))
    with pytest.raises(FrameConflict) if raised else nullcontext():
        assert await ego.ask(SimpleNamespace(ego_id="car-1", message=ego_message), 0) is None
    assert not answers
    assert ego.refused == ({"store-too-slow": 1} if first == 503 else {})


@pytest.mark.parametrize(
    ("refused", "said"),
    [
        ({}, None),
        ({"overloaded": 1}, "1 request was refused first (overloaded) and sent again."),
        ({"overloaded": 9, "draining": 2}, "11 requests were refused first (overloaded, draining) and sent again."),
    ],
)
def test_the_summary_tells_what_was_refused_first(refused, said, detector):
    (frame,) = Fleet(IntersectionScene(3), detector, 1, 0, PGD(steps=1), seed=0).sense(0)
    result = fuse(detector, Halving(), frame.message, frame.sent, rng=np.random.default_rng(0))
    summary = FleetSummary(detector, refused=Counter(refused))
    summary.add(frame, result.answer(0, {}, {"total": 1.0}, frame.ego_id), 10.0)
    console = Console(file=io.StringIO(), width=120)
    summary.print(console)
    text = console.file.getvalue()
    assert said in text if said else "refused first" not in text
    assert summary.as_dict()["refused_first"] == refused
    assert "lost" not in text
    summary.lost = 1
    summary.print(console)
    assert "1 answer was lost: the database took longer" in console.file.getvalue()


@pytest.mark.parametrize("lacks", [False, True])
def test_the_summary_tells_that_no_objects_are_judged(lacks, detector):
    (frame,) = Fleet(IntersectionScene(3), detector, 1, 0, PGD(steps=1), seed=0).sense(0)
    result = fuse(detector, Halving(), frame.message, frame.sent, rng=np.random.default_rng(0))
    summary = FleetSummary(detector, lacks_witness=lacks)
    summary.add(frame, result.answer(0, {}, {"total": 1.0}, frame.ego_id), 10.0)
    console = Console(file=io.StringIO(), width=200)
    summary.print(console)
    told = "intersection-mean has no witness, so group testing judges no single objects with it: robosac witness"
    assert (told in console.file.getvalue()) is lacks
    assert summary.as_dict()["lacks_witness"] is lacks


class Silent(Halving):
    kind: Literal["silent"] = "silent"

    def converse(self, team, state, rng):
        yield [tuple(team)]


def test_the_summary_tells_that_a_defence_fails_in_the_gateway(detector):
    (frame,) = Fleet(IntersectionScene(3), detector, 1, 0, PGD(steps=1), seed=0).sense(0)
    result = fuse(detector, Silent(), frame.message, frame.sent, rng=np.random.default_rng(0))
    summary = FleetSummary(detector)
    summary.add(frame, result.answer(0, {}, {"total": 1.0}, frame.ego_id), 10.0)
    console = Console(file=io.StringIO(), width=200)
    summary.print(console)
    why = "TypeError: silent: converse must return a Decision, got a NoneType"
    assert f"Cut short: 1 by a fault. The first fault: {why}" in console.file.getvalue()
    assert (summary.as_dict()["degraded"], summary.as_dict()["fault"]) == ({"fault": 1}, why)


def test_a_defence_that_names_without_suspicion_is_told_to_name(detector):
    (frame,) = Fleet(IntersectionScene(3), detector, 1, 1, PGD(steps=1), seed=0).sense(0)
    (attacker,) = frame.attackers
    result = fuse(detector, Halving(), frame.message, frame.sent, rng=np.random.default_rng(0))
    answer = result.answer(0, {}, {"total": 1.0}, frame.ego_id)
    named = RejectedTeammate(vehicle_id=attacker, reason=Reason.DISTRUSTED, distrust=Distrust.NAMED)
    accepted = tuple(name for name in answer.accepted if name != attacker)
    answer = answer.model_copy(update={"accepted": accepted, "rejected": {**answer.rejected, attacker: named}})
    assert answer.suspicion is None
    summary = FleetSummary(detector)
    summary.add(frame, answer, 10.0)
    assert summary.naming["attackers_named"] == 1


async def test_a_gateway_that_ends_in_the_block_is_told_of_with_its_log(tmp_path, monkeypatch):
    log = tmp_path / "gateway.log"
    monkeypatch.setattr(GatewayProcess, "ready", GatewayProcess.kill)
    with pytest.raises(GatewayUnreachable, match=f"this command started has ended with status -9; its log, {log}"):
        async with local_gateway(log):
            raise GatewayUnreachable("is the gateway running?")


@pytest.mark.parametrize(
    ("option", "given", "why"),
    [
        ("--attackers", "9", "must be between 0 and the 5 vehicles that are no egos, got 9"),
        ("--egos", "9", "must be between 1 and the 5 that may be one, got 9"),
        ("--first-scene", "5000", "synthetic has 1000 test scenes; 5004 are wanted"),
        ("--scenes", "1001", "synthetic has 1000 test scenes; 1001 are wanted"),
        ("--url", "127.0.0.1:8800", "must begin with http:// or https://, got 127.0.0.1:8800"),
        ("--budget-ms", "60001", "less than or equal to 60000"),
        ("--detector", "nosuch.safetensors", "there is no file nosuch.safetensors"),
    ],
)
def test_an_option_that_cannot_be_is_named(option, given, why):
    result = CliRunner().invoke(command(main), [option, given])
    assert result.exit_code == 2
    said = " ".join(result.output.replace("│", "").split())
    assert option in said
    assert why in said


def test_settings_of_a_defence_need_its_kind():
    result = CliRunner().invoke(command(main), ["--attacker-ratio", "0.4"])
    assert result.exit_code == 2
    assert "--defense" in result.output
