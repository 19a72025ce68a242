"""No command overwrites what is there unless it is told to, and says so before it works."""

import io
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from robosac.cli import app, commands
from robosac.cli.blame import check_known
from robosac.cli.outputs import tell

runner = CliRunner()
WRITTEN = {
    "scene": ("--out", "x.png"),
    "show frame": ("--out", "x.png"),
    "show film": ("--out", "x.gif"),
    "show suspicion": ("--out", "x.svg"),
    "show comparison": ("--out", "x.png"),
    "train": ("--out", "intersection-mean.safetensors"),
    "evaluate": ("--out", "bounds.json"),
    "benign-scores": ("--out", "x.json"),
    "reproduce": ("--out", "report.md"),
    "compare": ("--out", "comparison.md"),
    "calibrate": ("--out", "x.json"),
    "witness": ("--out", "x.safetensors"),
    "convert-checkpoint": ("OUT", "x.safetensors"),
    "audit report": ("--out", "x.json"),
    "record export": ("--out", "x.jsonl"),
    "demo": ("--report", "summary.json"),
    "fleet": ("--report", "summary.json"),
    "load-test": ("--out", "load_test.json"),
    "overload": ("--out", "overload.json"),
    "flood": ("--out", "flood.json"),
    "adversary": ("--out", "adversary.json"),
    "crash-test": ("--out", "crash_test.json"),
    "capacity": ("--out", "capacity.json"),
}
"""By command: what its user names, and what it would write there."""
FOLDERS = ("train", "evaluate", "reproduce", "compare", *list(WRITTEN)[15:])
ARGUMENTS = {
    "audit report": ["pyproject.toml", "--vehicle", "car-2"],
    "show comparison": ["docs/comparison/comparison.csv"],
    "record export": ["nowhere.mcap", "--to", "cpm"],
    "capacity": ["pyproject.toml"],
}


def every_command():
    """All commands by what a user types, those inside another one too."""
    for name, place in commands.places().items():
        command = commands.load(name, place)
        inner = getattr(command, "commands", {})
        yield from ((f"{name} {each}", inner[each]) for each in inner) if inner else [(name, command)]


def test_every_command_that_writes_can_be_forced():
    writing = {
        name
        for name, command in every_command()
        if any(parameter.name in ("out", "report") for parameter in command.params)
    }
    forced = {name for name, command in every_command() if any(p.name == "force" for p in command.params)}
    assert writing == forced == set(WRITTEN)


@pytest.mark.parametrize("name", WRITTEN)
def test_a_command_refuses_to_overwrite_before_it_works(name, tmp_path):
    option, file = WRITTEN[name]
    there = tmp_path / file
    there.write_text("made in hours")
    place = str(tmp_path if name in FOLDERS else there)
    where = ["/nowhere.pth", place] if option == "OUT" else [*ARGUMENTS.get(name, []), option, place]
    result = runner.invoke(app, [*name.split(), *where], env={"COLUMNS": "400"})
    assert result.exit_code == 2, result.output
    assert f"Invalid value for {option}: {there} is there already; --force overwrites it" in result.output
    assert there.read_text() == "made in hours"
    assert list(tmp_path.iterdir()) == [there]


def test_a_command_overwrites_if_it_is_told_to(tmp_path):
    (tmp_path / "bounds.json").write_text("old")
    short = ["evaluate", "--scenes", "1", "--frames", "1", "--out", str(tmp_path), "--force"]
    result = runner.invoke(app, short)
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "bounds.json").read_text())["frames"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bounds.json"]


@pytest.mark.parametrize(
    ("name", "place"), [("scene", "file/x.png"), ("scene", "folder"), ("compare", "file"), ("calibrate", "folder")]
)
def test_a_place_that_cannot_be_written_to_is_refused_before_the_work(name, place, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    result = runner.invoke(app, [name, "--out", str(tmp_path / place), "--force"], env={"COLUMNS": "400"})
    assert result.exit_code == 2
    assert "Invalid value for --out" in result.output


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "--out"),
        ("compare", "--out"),
        ("fleet", "--report"),
        ("record", "export", "none.mcap", "--to", "cpm", "--out"),
    ],
)
def test_a_file_in_the_place_of_a_folder_is_called_one(words, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    place = file / "x.jsonl" if words[0] == "record" else file
    result = runner.invoke(app, [*words, str(place)], env={"COLUMNS": "400"})
    assert result.exit_code == 2
    assert f"Invalid value for {words[-1]}: {file} is a file; a folder is wanted" in result.output


def test_a_folder_with_the_rest_of_an_interrupted_run_is_taken(tmp_path):
    (tmp_path / "precision.png").write_text("")
    arguments = ["compare", "--only", "no defence", "--setting", "honest:0", "--scenes", "1", "--frames", "6", "--live"]
    result = runner.invoke(app, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    again = runner.invoke(app, [*arguments, "--out", str(tmp_path)])
    assert again.exit_code == 2
    assert "--force" not in (tmp_path / "comparison.md").read_text()


def test_what_is_wrong_with_an_option_is_said_under_the_name_that_was_typed():
    for option in ("--detector", "--weights"):
        for words in ([option, "nonesuch"], [f"{option}=nonesuch"]):
            result = runner.invoke(app, ["evaluate", *words], env={"COLUMNS": "400"})
            assert result.exit_code == 2
            assert f"Invalid value for {option}: no detector 'nonesuch'" in result.output


def test_work_that_fails_ends_with_a_line():
    from robosac.cli.blame import failing

    own = typer.Typer()

    @own.command()
    def run() -> None:
        with failing(OSError):
            raise OSError("the disk is full")

    result = runner.invoke(own, [])
    assert (result.exit_code, result.output) == (1, "Error: the disk is full\n")


def test_a_file_that_is_not_there_is_told_by_its_name(tmp_path):
    result = CliRunner().invoke(app, ["audit", "show", str(tmp_path / "nosuch")], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert f"FILE: {tmp_path / 'nosuch'}: No such file or directory" in result.output


def test_names_are_listed_as_one_types_them():
    with pytest.raises(typer.BadParameter, match=r"unknown x; known: plain, 'group_testing, expecting \.2 m'$"):
        check_known(["x"], ["plain", "group_testing, expecting .2 m"], "--only")


def test_the_name_of_a_file_is_told_as_it_is_and_whole():
    console = Console(file=io.StringIO(), width=20)
    for path in ("out[1]/[/x]/[red]:smile:.json", "a/" * 20 + "[bold]"):
        tell(console, f"Written: {path}")
        assert console.file.getvalue().endswith(f"Written: {path}\n")


@pytest.mark.parametrize("words", [["--help"], ["audit", "show", "--help"], ["audit", "verify", "LOG"]])
def test_what_nobody_reads_is_no_outcome_of_a_check(words, tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text("{}\n")
    words = [str(log) if word == "LOG" else word for word in words]
    program = [sys.executable, "-c", "from robosac.cli import app; app()", *words]
    running = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    running.stdout.close()
    with running.stderr as said:
        assert said.read() == ""
    assert running.wait() == 128 + signal.SIGPIPE


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("words", [["--version"], ["audit", "verify", "LOG"]])
def test_what_cannot_be_printed_ends_with_a_line_and_is_no_outcome_of_a_check(words, tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text("{}\n")
    words = [str(log) if word == "LOG" else word for word in words]
    program = [sys.executable, "-c", "from robosac.cli import app; app()", *words]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(program, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (2, "Error: No space left on device\n")
