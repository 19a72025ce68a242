import os
import subprocess
import sys
from pathlib import Path

import pytest
from alembic import command
from alembic.config import Config

from robosac.extras import MissingExtra
from service.keeping import migrations
from service.keeping.database import connect

URL = "postgresql://user:password@nowhere/gateway"
MESSAGE = "asyncpg is not installed, for PostgreSQL: pip install 'robosac[postgresql]'"
WITHOUT = "import sys; sys.modules.update(asyncpg=None, matplotlib=None); "


async def test_sqlite_needs_no_driver_and_postgresql_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "asyncpg", None)
    await connect("sqlite://").close()
    with pytest.raises(MissingExtra) as raised:
        connect(URL)
    assert str(raised.value) == MESSAGE


def test_the_gateway_ends_in_one_line_and_serves_sqlite_all_the_same():
    environment = {name: value for name, value in os.environ.items() if not name.startswith("ROBOSAC_")}
    serve = [sys.executable, "-c", WITHOUT + "import uvicorn; uvicorn.main(['service.app:app', '--port', '0'])"]
    ended = subprocess.run(
        serve, env=environment | {"ROBOSAC_DATABASE_URL": URL}, capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (2, f"Error: ROBOSAC_DATABASE_URL: {MESSAGE}\n")
    made = [sys.executable, "-W", "error", "-c", WITHOUT + "import service.app"]
    subprocess.run(made, env=environment | {"ROBOSAC_DATABASE_URL": "sqlite://"}, timeout=60, check=True)


def test_steps_by_hand_end_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "asyncpg", None)
    monkeypatch.setenv("ROBOSAC_DATABASE_URL", URL)
    with pytest.raises(SystemExit) as raised:
        command.upgrade(Config(Path(migrations.__file__).parent / "alembic.ini"), "head")
    assert raised.value.code == f"Error: {MESSAGE}"


def test_steps_by_hand_ask_which_database(monkeypatch, tmp_path):
    monkeypatch.delenv("ROBOSAC_DATABASE_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="ROBOSAC_DATABASE_URL has to name the database"):
        command.upgrade(Config(Path(migrations.__file__).parent / "alembic.ini"), "head")
    assert not list(tmp_path.iterdir())
