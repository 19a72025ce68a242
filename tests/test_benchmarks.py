"""The command that measures all ratios: one part of it, briefly."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def run(name, *options):
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), *options]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"}, check=False)


@pytest.fixture
def refused(monkeypatch):
    """What a command says that it refuses."""
    monkeypatch.syspath_prepend(BENCHMARKS)

    def said(name, *options):
        own = typer.Typer()
        own.command()(importlib.import_module(name).main)
        done = CliRunner().invoke(own, options, env={"COLUMNS": "200"})
        assert done.exit_code == 2, done.output
        return " ".join(done.stderr.split())

    yield said
    for name in [
        name for name, module in sys.modules.items() if str(BENCHMARKS) in str(getattr(module, "__file__", ""))
    ]:
        del sys.modules[name]


def test_a_part_is_a_table_of_ratios(refused, tmp_path):
    page = tmp_path / "speed.md"
    done = run("ratios", "--only", "once", "--turns", "3", "--out", str(page))
    assert done.returncode == 0, done.stderr
    lines = page.read_text().splitlines()
    assert lines[0] == "# Speed"
    assert lines[2].startswith("Written by `python benchmarks/ratios.py --only once`")
    (row,) = [line.split("|") for line in lines if "encoded and warped for each" in line]
    assert float(row[2]) > 2.0  # seven hypotheses, and the ego alone: encoding six scans for each is most of the work
    kept = page.read_text()
    assert "--force overwrites it" in refused("ratios", "--only", "once", "--out", str(page))
    assert page.read_text() == kept


def test_an_unknown_part_is_named(refused):
    assert "nonsense: not one of once, v2xsim" in refused("ratios", "--only", "nonsense")


def test_a_device_that_is_not_there_is_refused(refused):
    assert "torch cannot compute on the device 'nonsense' here" in refused("device", "--device", "nonsense")


def test_a_device_is_measured():
    done = run("device", "--turns", "1", "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert "intersection-mean on cpu, 5 teammates" in done.stdout
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in done.stdout.splitlines() if "│" in line]
    assert [row[0] for row in cells[:3]] == ["one by one", "8 at once", "8 at once, from its last message on"]
    assert [row[0] for row in cells[3:6]] == ["prepared", "decoded", "compared"]
    assert [row[0] for row in cells[6:12]] == ["1", "2", "4", "8", "16", "32"]
    assert all(float(cell) > 0 for row in cells for cell in row[1:] if cell)
