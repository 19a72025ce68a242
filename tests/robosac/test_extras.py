import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.extras import _EXTRAS, MissingExtra, need

PLOTS = "Error: matplotlib is not installed, for pictures: pip install 'robosac[plots]'\n"
EXTRAS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.mark.parametrize(("package", "extra"), _EXTRAS.items())
def test_what_is_missing_is_named_with_the_extra_that_brings_it(package, extra, monkeypatch):
    need(package, "this test")  # which has it installed
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtra, match=rf"{package} is not .*, for this test: pip install 'robosac\[{extra}\]'$"):
        need(package, "this test")
    names = (f"{package}>", f"{package}-sdk>", f"{package}[")
    assert any(requirement.startswith(names) for requirement in EXTRAS[extra])


@pytest.mark.parametrize(
    "arguments",
    [
        ["scene", "--out", "x.png"],
        ["show", "frame", "--out", "x.png"],
        ["show", "film", "--out", "x.gif"],
        ["reproduce", "--out", "x", "--quick"],
        ["compare", "--out", "x", "--quick"],
    ],
)
def test_a_command_that_draws_says_at_once_that_it_cannot(arguments, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert result.output == PLOTS
    assert not list(tmp_path.iterdir())
