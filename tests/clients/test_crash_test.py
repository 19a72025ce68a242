import contextlib
import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from clients.client import FrameAnswer, OpenedSession
from clients.crash_test import sqlite
from clients.crash_test.__main__ import main
from clients.crash_test.driven import Driven
from clients.crash_test.rounds import possible
from robosac.audit import commitment, digest, seal
from robosac.audit.packing import state_digest

SEEDS = ["ab" * 32, "cd" * 32]
ANSWER = {
    "boxes": [[1.0, 2.5, 4.0, 2.0, 0.1, 0.9]], "source": "consensus", "accepted": ["a"], "rejected": [],
    "hypotheses": [], "sampling_steps": 1, "attacker_ratio": None, "deadline_met": True, "degraded_by": None,
    "timings_ms": {"total": 1.5},
}  # fmt: skip


@pytest.fixture
def driven():
    return Driven("none", OpenedSession("s", "token", {}, "2100-01-01T00:00:00Z", {}, {}))


def log(*frames, seeds=SEEDS):
    """Lines of a session that answered these frames."""
    events = [{"event": "session_opened", "next_seed_commitment": commitment(SEEDS[0]), "state": {}}]
    for frame, seed in zip(frames, seeds, strict=False):
        answer = {**ANSWER, "frame": frame, "seed": seed, "state": {"n": frame}}
        events.append({"event": "frame_answered", **answer, "next_seed_commitment": commitment(SEEDS[1])})
    lines, head = [], "0" * 64
    for seq, event in enumerate(events, 1):
        lines.append(seal(event, "s", seq, head))
        head = digest(lines[-1])
    return lines


def complaints(driven, lines):
    return [complaint for line in lines for complaint in driven.follow(line)]


def test_no_incident_loses_anything(tmp_path):
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(
        app, ["--kills", "2", "--incident", "backup", "--incident", "pair", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    kills = json.loads((tmp_path / "crash_test.json").read_text())["kills"]
    assert [kill["incident"] for kill in kills] == ["backup", "pair"]
    assert [kill["wrong"] for kill in kills] == [[], []]
    assert sum(kill["acknowledged"] for kill in kills) >= 4
    assert all(kill["unacknowledged"] >= 0 for kill in kills)


def test_a_good_log_is_followed(driven):
    driven.acknowledged = {0: FrameAnswer.model_validate({**ANSWER, "frame": 0})}
    lines = log(0, 1)
    assert complaints(driven, lines) == []
    assert (driven.seq, driven.head, driven.answered, driven.last_frame) == (3, digest(lines[-1]), 2, 1)
    assert (driven.acknowledged, driven.state_digest) == ({}, state_digest({"n": 1}))


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (log(0, 1)[:1] + log(0, 1)[2:], "not sealed"),
        ([log(0)[0], log(0)[1].replace("consensus", "trusted")], "another result"),
        (log(0, 1, seeds=[SEEDS[1], SEEDS[1]]), "another seed"),
        (log(1, 0), "decided after"),
    ],
)
def test_a_bad_log_is_found_out(driven, lines, complaint):
    driven.acknowledged = {0: FrameAnswer.model_validate({**ANSWER, "frame": 0})}
    assert any(complaint in one for one in complaints(driven, lines))


def test_boxes_count_too(driven):
    answer = FrameAnswer.model_validate({**ANSWER, "frame": 0, "boxes": np.ones((1, 6))})
    driven.acknowledged = {0: answer}
    assert any("another result" in one for one in complaints(driven, log(0)))


def test_a_damaged_file_is_found_out(tmp_path):
    path, copy = tmp_path / "robosac.db", tmp_path / "copy.db"
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE audit_lines (line)")
        database.execute("CREATE INDEX by_line ON audit_lines (line)")
        database.executemany("INSERT INTO audit_lines VALUES (?)", [(f"{n:0500}",) for n in range(50)])
        database.commit()
    assert sqlite.read_and_back_up(path, copy) == sqlite.integrity(copy) == sqlite.integrity(path) == []
    content = bytearray(path.read_bytes())
    content[5000:9000] = bytes(4000)
    path.write_bytes(content)
    assert sqlite.integrity(path)
    assert sqlite.read_and_back_up(path, copy)
    path.write_bytes(b"no database" * 500)
    (complaint,) = sqlite.integrity(path)
    assert "not a database" in complaint
    (complaint,) = sqlite.read_and_back_up(path, copy)
    assert "could not be backed up" in complaint


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("mysql://u:secret@x/y", "a database must be one of sqlite, postgresql, postgresql+asyncpg, not mysql"),
        ("secret", "not a database URL"),
    ],
)
def test_a_database_that_no_gateway_takes_is_refused(url, told):
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--database-url", url], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert told in result.output
    assert "secret" not in result.output


def test_only_a_sqlite_file_is_backed_up(tmp_path):
    assert sqlite.path_of("sqlite:////data/robosac.db?timeout=3") == Path("/data/robosac.db")
    url = "postgresql://nobody@/x"
    assert sqlite.path_of(url) is None
    assert [*possible("sqlite:////data/robosac.db")] == ["kill", "backup", "pair"]
    assert [*possible(url)] == ["kill", "pair"]
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--incident", "backup", "--database-url", url])
    assert result.exit_code == 2
    assert "--incident" in result.output
