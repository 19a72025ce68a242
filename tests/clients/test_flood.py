import json
import subprocess
import sys

from clients.flood import BODY_BYTES, Refusals, requests_of
from service.settings import Settings


def test_strangers_are_refused_and_honest_egos_answered(tmp_path):
    """As a command, since its strangers are a process of their own."""
    options = ["--seconds", "1", "--rate", "10", "--egos", "1", "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "clients.flood", *options], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "flood.json").read_text())
    assert list(report) == ["none", "headers only", "whole bodies"]
    for name, part in report.items():
        assert part["honest"]["frames"] + sum(part["honest"]["errors"].values()) == 5
        strangers = part["strangers"]
        assert (strangers["sent"], strangers["others"]) == (0 if name == "none" else 10, {})
        assert len(strangers["refused_ms"]) + strangers["hung_up"] == strangers["sent"]
        assert name == "whole bodies" or strangers["hung_up"] == 0
    assert report["whole bodies"]["strangers"]["taken_bytes"] > 0


def test_what_is_no_refusal_is_told():
    refusals = Refusals()
    for status in (401, 503, 408, 408):
        refusals.answered(status, 1.0)
    assert (refusals.refused_ms, refusals.others) == ([1.0, 1.0], {"408": 2})


def test_bodies_are_announced_as_large_as_a_gateway_reads():
    assert Settings().max_body_bytes == BODY_BYTES
    heads = requests_of("http://host", "s", "c")
    assert len(heads) == 10
    assert all(f"Content-Length: {BODY_BYTES}".encode() in head for head in heads)
