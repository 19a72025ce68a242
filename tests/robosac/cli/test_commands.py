import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robosac.cli import app, commands

runner = CliRunner()
PROJECT = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
BROUGHT = PROJECT["entry-points"][commands.GROUP]


@pytest.fixture
def brought(monkeypatch, tmp_path):
    """Commands of other packages instead of those that are installed; by default those that this project declares."""
    info = tmp_path / "robosac-0.dist-info"  # found first, it stands for the installed package of that name
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: robosac\nVersion: 0\n")
    monkeypatch.syspath_prepend(tmp_path)

    def bring(points):
        lines = [f"[{commands.GROUP}]", *(f"{name} = {place}" for name, place in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines))

    bring(BROUGHT)
    return bring


def words(text):
    return " ".join(text.replace("│", " ").split())


@pytest.mark.parametrize(("name", "place"), [*commands.OWN.items(), *BROUGHT.items()])
def test_the_help_says_of_a_command_what_it_says_of_itself(name, place, brought):
    summary = commands.summary(place)
    assert summary
    command = commands.load(name, place)
    assert command.help.partition("\n\n")[0] == summary
    for each in (command, *getattr(command, "commands", {}).values()):
        assert "\n" not in each.help.replace("\n\n", "")  # else lines would break in the middle
    assert summary in words(runner.invoke(app, ["--help"], terminal_width=400).output)
    own = runner.invoke(app, [name, "--help"], terminal_width=400)
    assert own.exit_code == 0, own.output
    assert summary in words(own.output)
    assert f" {name} [OPTIONS]" in own.output


def test_the_help_imports_no_command():
    code = """
import sys
from robosac.cli import app
app(["--help"], standalone_mode=False)
names = [name for name in ("torch", "scipy", "numpy", "uvicorn", "clients.client") if name in sys.modules]
assert not names, names
"""
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_checking_a_log_needs_no_torch():
    code = """
import sys
from robosac.cli import app
app(["audit", "verify", "--help"], standalone_mode=False)
names = [name for name in ("torch", "scipy") if name in sys.modules]
assert not names, names
"""
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_a_command_that_another_package_brings_is_run(brought, tmp_path):
    (tmp_path / "other_package.py").write_text(
        'def greet(name: str) -> None:\n    """Greet.\n\n    Further words.\n    """\n    print(f"Hello {name}")\n'
    )
    brought({"greet": "other_package:greet", "scene": "other_package:greet"})
    assert commands.places()["scene"] == commands.OWN["scene"]
    listed = runner.invoke(app, ["--help"]).output
    assert "Greet." in listed
    assert "Further" not in listed
    assert "other_package" not in sys.modules
    assert runner.invoke(app, ["greet", "Ann"]).output == "Hello Ann\n"


@pytest.mark.parametrize("place", ["nonesuch_package.sub:main", "broken_package:main", "sys:exit"])
def test_a_command_that_cannot_be_read_is_listed_without_words(place, brought, tmp_path):
    (tmp_path / "broken_package.py").write_text("def main(:")
    brought({"odd-one": place})
    result = runner.invoke(app, ["--help"])
    assert result.exit_code == 0, result.output
    assert "odd-one" in result.output


def test_commands_are_completed_by_name(brought):
    environment = {"_ROBOSAC_COMPLETE": "complete_bash", "COMP_WORDS": "robosac fl", "COMP_CWORD": "1"}
    result = runner.invoke(app, [], prog_name="robosac", env=environment)
    assert result.output.split() == ["fleet", "flood"]


def test_a_missing_extra_ends_a_command_in_one_line(brought, tmp_path):
    (tmp_path / "needing_package.py").write_text(
        "from robosac.extras import MissingExtra\n"
        "def main() -> None:\n    raise MissingExtra('matplotlib is not installed')\n"
    )
    brought({"need": "needing_package:main"})
    result = runner.invoke(app, ["need"])
    assert result.exit_code == 2
    assert result.output == "Error: matplotlib is not installed\n"
