import io
import json
import sys

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from clients.load_test import Bodies, _placed, main, show
from clients.measured import Figures, Load
from robosac import wire


def test_a_short_run_measures_every_load(tmp_path):
    app = typer.Typer()
    app.command()(main)
    arguments = [
        "--seconds",
        "0.6",
        "--egos",
        "1",
        "--egos",
        "3",
        "--teammates",
        "5",
        "--rate",
        "5",
        "--out",
        str(tmp_path),
        "--budget-ms",
        "20000",
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "load_test.json").read_text())
    loads = report["loads"]
    assert {(load["loop"], load["egos"], load["attacked"]) for load in loads} == {
        (loop, egos, attacked) for loop in ("closed", "open") for egos in (1, 3) for attacked in (False, True)
    }
    assert report["bytes_a_frame"] > 6 * 64 * 32 * 32 * 2
    for load in loads:
        assert load["errors"] == {}
        assert load["fps"] > 0
        assert load["latency_ms"]["p50"] <= load["latency_ms"]["p95"] <= load["latency_ms"]["p99"]
        assert load["sampling_steps_mean"] >= 1
        assert sum(of["frames"] for of in load["by_steps"].values()) == load["frames"]
        assert all(0 < of["engine_ms"] < of["latency_ms"] for of in load["by_steps"].values())
        used = load["used_a_frame"]
        assert report["bytes_a_frame"] < used["sent_bytes"] < report["bytes_a_frame"] + 2000
        assert 1000 < used["audit_bytes"] < 20_000
        assert 0 < used["gateway_cpu_ms"] < 2000
        if sys.platform == "linux":
            assert used["gateway_cpu_ms"] + used["client_cpu_ms"] < used["machine_cpu_ms"] + 100  # it counts in 10 ms
        assert load["placed"] == [load["egos"]]
        assert all(milliseconds > 0 for milliseconds in load["pace"].values())
        assert {"receive", "queue", "prepare", "hypotheses", "total"} <= set(load["stages_ms"])
        if load["loop"] == "open":
            assert load["frames"] == load["egos"] * 3


def test_addresses_of_processes_are_looked_at_before_any_work():
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--url", "http://127.0.0.1:9", "--process", "127.0.0.1:9"])
    assert result.exit_code == 2
    said = " ".join(result.output.replace("│", "").split())
    assert "for '--process': must begin with http:// or https://, got 127.0.0.1:9" in said


def test_no_figure_is_cut_off_in_a_narrow_terminal():
    figures = Figures(Load("open", 8, attacked=True, rate_hz=5.0), budget_ms=200.0, seconds=2.0)
    figures.latencies_ms += [123.0] * 3
    figures.steps += [1] * 3
    figures.engine_ms += [9.0] * 3
    for number in range(12):
        figures.stages[f"stage{number}"].append(1234.5)
    console = Console(file=io.StringIO(), width=40)
    show(console, [figures], 788_000, 200.0)
    text = console.file.getvalue()
    assert "…" not in text
    assert [line.count("1234.5") for line in text.splitlines() if "1234.5" in line] == [12]


def test_egos_are_placed_where_their_first_frames_were_answered():
    assert _placed([10, 4], [19, 7], 4) == [3, 1]
    assert _placed([0], [3 * 4 + 1], 4) == [4]  # somebody else's frame, too
    assert _placed([0, 0], [9, 9], 4) is None


def test_refused_frames_count_as_not_answered_in_time():
    figures = Figures(Load("closed", 1, attacked=False), budget_ms=200.0, seconds=2.0)
    answer = type(
        "Answer",
        (),
        {
            "sampling_steps": 1,
            "deadline_met": True,
            "degraded_by": "deadline",
            "timings_ms": {"prepare": 2.0, "total": 3.0},
        },
    )()
    figures.add(answer, 10.0)
    figures.add(answer, 300.0)
    figures.errors["GatewayUnavailable"] += 2
    values = figures.as_dict()
    assert values["fps"] == 1.0
    assert values["within_budget_share"] == 0.25


@pytest.mark.parametrize("index", [0, 3, 200, 70_000])
def test_prepared_bodies_are_renumbered(ego_message, benign, index):
    bodies = Bodies([wire.pack_frame(0, ego_message, benign)])
    assert bodies.numbered(index) == wire.pack_frame(index, ego_message, benign)
