import re
import tomllib
from pathlib import Path

from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parent.parent


def test_imports_keep_to_the_rules(capsys):
    """The rules are in pyproject.toml."""
    status = lint_imports(str(ROOT / "pyproject.toml"), no_cache=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_the_layers_are_those_of_the_readme():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    readme = (ROOT / "README.md").read_text().partition("## Find your way")[2]
    listed = re.findall(r"^  (\w+)/? +\S", readme.partition("\nservice/")[0], re.MULTILINE)
    assert listed == contracts[0]["layers"][::-1]
