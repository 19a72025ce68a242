import sqlite3
from contextlib import closing

import pytest

from service.app import create_app
from service.engine import Engine
from service.settings import Settings
from service.watching.starting import Starting
from tests.service.conftest import serve


async def started(app):
    """What a server is told when it starts an app that cannot."""
    told = []

    async def receive():
        return {"type": "lifespan.startup"}

    async def send(message):
        told.append(message)

    with pytest.raises((ValueError, ZeroDivisionError)) as raised:
        await app({"type": "lifespan", "asgi": {}, "state": {}}, receive, send)
    (message,) = told
    assert message["type"] == "lifespan.startup.failed"
    return message["message"], raised.value


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"extra_detectors": "nonesuch:build"}, "ROBOSAC_EXTRA_DETECTORS: nonesuch:build: ModuleNotFoundError: No "),
        ({"extra_detectors": "pyproject.toml"}, "ROBOSAC_EXTRA_DETECTORS: pyproject.toml is not a readable "),
        (
            {"extra_detectors": "tests.service.test_starting:Fragile"},
            "ROBOSAC_EXTRA_DETECTORS: intersection-mean cannot answer a frame of zeros: ZeroDivisionError: ",
        ),
        ({"device": "nonesuch"}, "ROBOSAC_DEVICE: torch cannot compute on the device 'nonesuch' here: "),
        ({"detector": "nonesuch"}, "ROBOSAC_DETECTOR: unknown detector 'nonesuch'"),
        ({"database_url": "sqlite:////nowhere/x.db"}, "ROBOSAC_DATABASE_URL: /nowhere/x.db: OperationalError: "),
        ({"gateway_key_file": "/"}, "ROBOSAC_GATEWAY_KEY_FILE: / cannot be read: Is a directory"),
        ({"gateway_key_file": "/nowhere/key"}, "ROBOSAC_GATEWAY_KEY_FILE: /nowhere/key cannot be read: No such file"),
    ],
)
async def test_a_setting_that_keeps_the_gateway_from_starting_is_named_in_a_line(settings, complaint):
    told, _ = await started(create_app(Settings(**{"database_url": "sqlite://", **settings})))
    assert told.startswith(complaint)
    assert "\n" not in told


def test_a_setting_that_needs_an_extra_is_named_in_a_line(monkeypatch, tmp_path):
    monkeypatch.setattr("robosac.extras.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"^ROBOSAC_RECORD: mcap is not installed, .*'robosac\[recordings\]'$"):
        create_app(Settings(database_url="sqlite://", record=tmp_path))


async def test_a_database_that_cannot_be_used_is_named_in_a_line(tmp_path):
    url = f"sqlite:///{tmp_path / 'sessions.db'}"
    async with serve(database_url=url):
        pass
    spoils = {
        "CREATE TRIGGER spoilt BEFORE INSERT ON secrets BEGIN SELECT RAISE(ABORT, 'no changes'); END": "no changes",
        "UPDATE alembic_version SET version_num = '9999'": "the database is of a later version of the gateway",
    }
    for spoil, complaint in spoils.items():
        with closing(sqlite3.connect(tmp_path / "sessions.db")) as database:
            database.execute("DELETE FROM secrets")
            database.execute(spoil)
            database.commit()
        told, _ = await started(create_app(Settings(database_url=url)))
        assert told.startswith("ROBOSAC_DATABASE_URL: ")
        assert complaint in told
        assert "\n" not in told


@pytest.mark.parametrize(("mode", "told"), [(0o600, False), (0o660, False), (0o644, True), (0o602, True)])
async def test_a_database_that_everybody_may_read_is_told_at_the_start(mode, told, tmp_path, caplog):
    path = tmp_path / "copy.db"
    async with serve(database_url=f"sqlite:///{path}"):
        pass
    assert "everybody may read" not in caplog.text
    path.chmod(mode)
    async with serve(database_url=f"sqlite:///{path}"):
        assert (f"everybody may read {path} or write to it" in caplog.text) is told
    assert path.stat().st_mode & 0o777 == mode


async def test_a_fault_that_is_no_setting_keeps_its_traceback(monkeypatch):
    async def broken(engine):
        1 / 0  # noqa: B018

    monkeypatch.setattr(Engine, "find_device", broken)
    told, raised = await started(create_app(Settings(database_url="sqlite://")))
    assert isinstance(raised, ZeroDivisionError)
    assert told.startswith("Traceback")


class Fragile:
    """A detector that cannot be warmed up."""

    @property
    def info(self):
        from robosac.detectors import EmbeddedDetector

        return EmbeddedDetector().info

    def prepare(self, ego, teammates):
        return 1 / 0


async def test_requests_pass():
    passed = []

    async def app(scope, receive, send):
        passed.append((scope, receive, send))

    await Starting(app)({"type": "http"}, "receive", "send")
    assert passed == [({"type": "http"}, "receive", "send")]


def test_a_defence_that_cannot_be_had_is_blamed_on_its_variable():
    with pytest.raises(ValueError, match=r"^ROBOSAC_EXTRA_DEFENSES: nonesuch:build: ModuleNotFoundError"):
        create_app(Settings(database_url="sqlite://", extra_defenses="nonesuch:build"))
