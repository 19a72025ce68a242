"""The command that measures all ratios: one part of it, briefly."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run(*options):
    command = [sys.executable, str(ROOT / "benchmarks" / "ratios.py"), *options]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"}, check=False)


def test_a_part_is_a_table_of_ratios(tmp_path):
    page = tmp_path / "speed.md"
    done = run("--only", "once", "--turns", "3", "--out", str(page))
    assert done.returncode == 0, done.stderr
    lines = page.read_text().splitlines()
    assert lines[0] == "# Speed"
    assert lines[2].startswith("Written by `python benchmarks/ratios.py --only once`")
    (row,) = [line.split("|") for line in lines if "encoded and warped for each" in line]
    assert float(row[2]) > 2.0  # seven hypotheses, and the ego alone: encoding six scans for each is most of the work
    kept = page.read_text()
    again = run("--only", "once", "--out", str(page))
    assert again.returncode == 2
    assert "--force overwrites it" in again.stderr
    assert page.read_text() == kept


def test_an_unknown_part_is_named():
    done = run("--only", "nonsense")
    assert done.returncode == 2
    assert "nonsense: not one of once, v2xsim" in " ".join(done.stderr.split())


def test_a_device_is_measured_and_one_that_is_not_there_is_refused():
    command = [sys.executable, str(ROOT / "benchmarks" / "device.py"), "--turns", "1", "--device"]
    env = os.environ | {"COLUMNS": "200"}
    done, refused = (
        subprocess.run([*command, device], capture_output=True, text=True, env=env, check=False)
        for device in ("cpu", "nonsense")
    )
    assert done.returncode == 0, done.stderr
    assert "intersection-mean on cpu, 5 teammates" in done.stdout
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in done.stdout.splitlines() if "│" in line]
    assert [row[0] for row in cells[:3]] == ["one by one", "8 at once", "8 at once, from its last message on"]
    assert [row[0] for row in cells[3:6]] == ["prepared", "decoded", "compared"]
    assert [row[0] for row in cells[6:12]] == ["1", "2", "4", "8", "16", "32"]
    assert all(float(cell) > 0 for row in cells for cell in row[1:] if cell)
    assert refused.returncode == 2
    assert "torch cannot compute on the device 'nonsense' here" in refused.stderr
