import json

import pytest
import typer
from typer.testing import CliRunner

from clients.overload import main


def test_more_frames_than_can_be_answered_are_refused_and_the_rest_answered(tmp_path):
    app = typer.Typer()
    app.command()(main)
    arguments = ["--seconds", "1.5", "--egos", "20", "--factor", "6", "--force", "--out", str(tmp_path)]
    for _ in range(3):  # a busy machine may stand still for a good part of so short a run
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        figures = json.loads((tmp_path / "overload.json").read_text())
        assert figures["answered"] > 0
        assert figures["refused"] > 0
        assert figures["answered"] + figures["refused"] + sum(figures["others"].values()) > figures["capacity_fps"]
        assert "Refused: median" in result.output
        if figures["deadline_met_share"] > 0.5:
            break
    else:
        pytest.fail(f"in time were only {figures['deadline_met_share']:.0%} of those answered")
