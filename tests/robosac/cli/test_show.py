"""Pictures from the command line; what they show is tested in tests/robosac/pictures."""

from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from robosac.cli import app

TABLE = Path(__file__).parents[3] / "docs" / "comparison" / "comparison.csv"


def show(*arguments):
    result = CliRunner().invoke(app, ["show", *map(str, arguments)])
    return result.exit_code, " ".join(result.output.replace("│", "").split())


def test_each_kind_of_picture_is_drawn(tmp_path):
    played = ["--attack", "noise", "--defense", "one_by_one", "--seed", "3", "--data", "world:highway"]
    for what, name, frames in (
        ("frame", "f.png", ()),
        ("film", "f.gif", ("--frames", "2")),
        ("suspicion", "s.svg", ("--frames", "2")),
    ):
        arguments = [*played, *(frames or ("--frame", "0"))]
        code, said = show(what, "--out", tmp_path / name, *arguments)
        assert code == 0, said
        assert "teammates fused" in said
    with Image.open(tmp_path / "f.gif") as film, Image.open(tmp_path / "f.png") as frame:
        assert film.n_frames == 2
        assert min(frame.size) > 900
    assert "<svg" in (tmp_path / "s.svg").read_text()


def test_the_figures_of_a_comparison_are_drawn(tmp_path):
    code, said = show("comparison", TABLE, "--column", "infiltrated", "--out", tmp_path / "x.png")
    assert code == 0, said
    assert "x.png: 374 figures" in said
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.width > 500


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["frame", "--out", "x.nonsense"], "a picture's name ends with one of"),
        (["film", "--out", "x.png"], "ends with .gif or .mp4"),
        (["film", "--out", "x.mp4"], "ffmpeg is not installed"),
        (["frame", "--out", "x.png", "--scene", "100000"], "test scenes, counted from 0"),
        (["frame", "--out", "x.png", "--attackers", "9"], "for --attackers: the scene has 5 teammates, not 9"),
        (["frame", "--out", "x.png", "--attack", "nonesuch"], "no attack 'nonesuch'"),
        (["frame", "--out", "x.png", "--defense", "nonesuch"], "no defence 'nonesuch'"),
        (["suspicion", "--out", "x.png", "--data", "nonesuch"], "no scene source 'nonesuch'"),
        (["comparison", "nonesuch.csv", "--out", "x.png"], "No such file"),
        (["comparison", str(TABLE), "--column", "nonesuch", "--out", "x.png"], "no figure 'nonesuch'; it has ap50"),
        (["comparison", str(TABLE), "--column", "nonesuch", "--out", "x.png"], "Invalid value for --column"),
    ],
)
def test_what_cannot_be_drawn_is_explained_before_any_work(arguments, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))  # no ffmpeg
    code, said = show(*arguments)
    assert code == 2
    assert why in said
    assert not list(tmp_path.iterdir())
