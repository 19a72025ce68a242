import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
CHECK = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports('pyproject.toml', no_cache=True))"


def test_imports_keep_to_the_rules():
    """The rules are in pyproject.toml. In a process of its own, since the check turns the loggers of this one off."""
    done = subprocess.run([sys.executable, "-c", CHECK], check=False, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_layers_are_those_of_the_readme():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    readme = (ROOT / "README.md").read_text().partition("## Find your way")[2]
    listed = re.findall(r"^  (\w+)/? +\S", readme.partition("\nservice/")[0], re.MULTILINE)
    assert listed == contracts[0]["layers"][::-1]
