import sys

import pytest
import typer
from typer.testing import CliRunner

from clients import demo, fleet


@pytest.mark.parametrize("main", [demo.main, fleet.main])
def test_without_matplotlib_a_report_is_refused_in_one_line_before_any_work(main, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    command = typer.Typer()
    command.command()(main)
    result = CliRunner().invoke(command, ["--report", str(tmp_path / "report")])
    assert result.exit_code == 2
    assert result.output == "Error: matplotlib is not installed, for pictures: pip install 'robosac[plots]'\n"
    assert not (tmp_path / "report").exists()
