"""How far a command is, where no bar can be drawn."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console, Group

from robosac.cli import options


@pytest.mark.parametrize(("terminal", "lines"), [(False, 3), (True, 0)])
def test_a_file_is_told_once_a_minute(terminal, lines, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(options, "time", SimpleNamespace(monotonic=lambda: now))
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    told = []
    monkeypatch.setattr(console, "print", lambda *what: told.extend(what))
    with options.progress(console) as bar:
        task = bar.add_task("frames", total=10)
        for _ in range(10):
            now += 20.0
            bar.advance(task)
        bar.update(task, completed=10)
    assert sum(isinstance(each, Group) for each in told) == lines


def test_a_line_says_how_far_it_is(monkeypatch):
    monkeypatch.setattr(options, "TOLD_EVERY_S", 0.0)
    out = io.StringIO()
    with options.progress(Console(file=out, width=100)) as bar:
        task = bar.add_task("frames", total=4)
        bar.update(task, completed=3)
        assert "frames" in out.getvalue()
        assert "3/4" in out.getvalue()
