import pytest

from service.keeping.database import connect
from service.keeping.urls import read_url
from service.settings import SettingsError, settings_of_environment

WRONG = [
    "",
    "nonsense",
    "sqlite:///file:secret.db?uri=true",
    "mysql://u:secret@h/d",
    "sqlite+pysqlite:///x",
    "sqlite://secret/x",
    *(f"sqlite:///x?{option}" for option in ("secret=1", "mode=ro", "isolation_level=DEFERRED", "timeout=1&secret=1")),
    *(f"sqlite:///x?timeout={value}" for value in ("secret", "-5", "nan", "inf", "1e300", "1&timeout=2")),
    *("sqlite:///which?.db", "sqlite:///x?timeout", "sqlite:///x?timeout=", "sqlite:///a?b?timeout=1"),
    "postgresql://u:p@h:secret/d",
    "postgresql://u:p@h:99999/d",
    "postgresql://u:p@h:0/d",
    "postgresql://u:p@/d?host=h&port=99999",
    "postgresql://u:p@h/d?secret=1",
    "postgresql://u:p@h/d?sslmode=require",
    "postgresql://u:p@h/d?timeout=5",
    "postgresql://u:p@/d?host=secret&host=h",
    "postgresql://u:p@h/d?port=secret",
]


@pytest.mark.parametrize("url", WRONG)
def test_other_urls_are_refused_without_showing_them(url, monkeypatch):
    with pytest.raises(ValueError, match="database") as caught:
        connect(url)
    assert "secret" not in str(caught.value)
    monkeypatch.setenv("ROBOSAC_DATABASE_URL", url)
    with pytest.raises(SettingsError, match=r"^ROBOSAC_DATABASE_URL: ") as named:
        settings_of_environment()
    assert "secret" not in str(named.value)


@pytest.mark.parametrize(
    "url",
    [
        "sqlite://",
        "sqlite:///x?timeout=0",
        "sqlite:///x?timeout=0.5",
        "postgresql://u:p@h:5432/d",
        "postgresql://u:p@/d?host=/run/postgresql&port=5433&ssl=require",
        "postgresql+asyncpg://u:p@/d?host=a:5432&host=b:5432&target_session_attrs=read-write",
    ],
)
async def test_what_the_drivers_take_is_taken(url):
    assert read_url(url).query == read_url(url.replace("+asyncpg", "")).query
    await connect(url).close()
