import re
import runpy
import subprocess
from pathlib import Path

import pytest

from service.settings import OTHERS, Settings, SettingsError, settings_of_environment
from tests.service.credentials import KEY

ROOT = Path(__file__).parents[2]
NUMBERS = [name for name, field in Settings.model_fields.items() if field.annotation in (int, float)]
HOSTILE = ["inf", "-inf", "nan", "1e300", "1e400", "5e-324", "1e-320", "1e-10", "-1", "-1e-320", "9" * 30, "9" * 5000]


@pytest.fixture
def environment(monkeypatch):
    """Sets variables of a gateway for a test."""

    def given(**values):
        for name, value in values.items():
            monkeypatch.setenv(name, value)

    return given


def test_all_numbers_are_found():
    of_type = {name for name, field in Settings.model_fields.items() if type(field.default) in (int, float)}
    assert set(NUMBERS) == of_type
    assert len(NUMBERS) >= 20


@pytest.mark.parametrize("value", HOSTILE, ids=lambda value: value[:8])
@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_that_cannot_be_is_refused_by_the_name_of_its_variable(name, value, environment):
    variable = f"ROBOSAC_{name.upper()}"
    environment(**{variable: value})
    with pytest.raises(SettingsError, match=f"^{variable}: "):
        settings_of_environment()


@pytest.mark.parametrize("name", NUMBERS)
def test_its_default_is_not(name, environment):
    environment(**{f"ROBOSAC_{name.upper()}": f"{Settings.model_fields[name].default}"})
    assert getattr(settings_of_environment(), name) == Settings.model_fields[name].default


@pytest.mark.parametrize(
    ("name", "value", "least"),
    [
        ("latency_budget_ms", "1e-9", "1"),
        ("max_budget_ms", "0.999", "1"),
        ("body_timeout_s", "1e-9", "0.1"),
        ("audit_max_records", "1", "2"),
    ],
)
def test_what_would_leave_every_frame_without_an_answer_is_refused_with_the_least_that_will_do(
    name, value, least, environment
):
    variable = f"ROBOSAC_{name.upper()}"
    environment(**{variable: value})
    with pytest.raises(SettingsError, match=f"^{variable}: .* greater than or equal to {least}$"):
        settings_of_environment()
    environment(**{variable: least})
    settings_of_environment()


@pytest.mark.parametrize(
    "url",
    [
        *(
            "http://a b",
            "http://a\tb/",
            "http://user:pw@host",
            "http://a:0",
            "http://*",
            "http://a/b c",
            "http://a:99999",
        ),
        *("ftp://a", "a", "http://", "http://a?b", "http://a#b"),
    ],
)
def test_a_public_address_under_which_nobody_can_ask_is_refused(url, environment):
    environment(ROBOSAC_PUBLIC_URL=url)
    with pytest.raises(SettingsError, match=r"^ROBOSAC_PUBLIC_URL: "):
        settings_of_environment()


@pytest.mark.parametrize(
    "url", ["https://Gateway.example", "http://[::1]:8000/", "http://10.0.0.1/a/b", "http://x:80/v"]
)
def test_a_public_address_is_taken(url, environment):
    environment(ROBOSAC_PUBLIC_URL=url)
    assert settings_of_environment().public_url == url


@pytest.mark.parametrize("value", ["", " "])
def test_a_path_that_is_set_to_nothing_is_none(value, environment):
    paths = [name for name, field in Settings.model_fields.items() if field.annotation == Path | None]
    assert {"record", "api_keys_file", "gateway_key_file"} <= set(paths)
    environment(**{f"ROBOSAC_{name.upper()}": value for name in paths})
    settings = settings_of_environment()
    assert [getattr(settings, name) for name in paths] == [None] * len(paths)


@pytest.mark.parametrize(
    ("variable", "meant"),
    [
        ("ROBOSAC_TOKN_TTL_S", "ROBOSAC_TOKEN_TTL_S"),
        ("ROBOSAC_APIKEYS", "ROBOSAC_API_KEYS"),
        ("ROBOSAC_API_KEY_FILE", "ROBOSAC_API_KEYS_FILE"),
        ("robosac_max_session", "ROBOSAC_MAX_SESSIONS"),
        ("ROBOSAC_LATENCY_BUDGET", "ROBOSAC_LATENCY_BUDGET_MS"),
        ("ROBOSAC_DATABASE", "ROBOSAC_DATABASE_URL"),
        ("ROBOSAC_XYZZY", None),
        ("ROBOSAC_", None),
    ],
)
def test_a_misspelt_variable_is_named_with_the_nearest_right_one(variable, meant, environment):
    environment(**{variable: KEY})
    with pytest.raises(SettingsError) as caught:
        settings_of_environment()
    assert str(caught.value) == f"{variable}: there is no such setting" + (f"; do you mean {meant}?" if meant else "")


def test_a_variable_in_capital_and_in_small_letters_is_one_and_set_twice(environment):
    environment(robosac_max_sessions="3", ROBOSAC_MAX_SESSIONS="4")
    with pytest.raises(SettingsError, match=r"^ROBOSAC_MAX_SESSIONS: is set 2 times"):
        settings_of_environment()


def test_all_that_is_wrong_is_told_at_once_and_no_value(environment):
    environment(
        ROBOSAC_TOKN=KEY, ROBOSAC_GATHER_MS="soon", ROBOSAC_TOKEN_TTL_S="inf", ROBOSAC_DATABASE_URL=f"x://{KEY}"
    )
    with pytest.raises(SettingsError) as caught:
        settings_of_environment()
    told = str(caught.value)
    assert [part.split(":")[0] for part in told.split("; ") if part.startswith("ROBOSAC_")] == [
        "ROBOSAC_TOKN",
        "ROBOSAC_TOKEN_TTL_S",
        "ROBOSAC_GATHER_MS",
        "ROBOSAC_DATABASE_URL",
    ]
    assert KEY not in told


@pytest.mark.parametrize(
    "variable",
    [
        *OTHERS,
        "ROBOSAC_SERVICE_HOST",
        "ROBOSAC_SERVICE_PORT_HTTP",
        "ROBOSAC_PORT",
        "ROBOSAC_PORT_8000_TCP_ADDR",
        "OMP_NUM_THREADS",
        "_ROBOSAC_COMPLETE",
        "MY_ROBOSAC_TOKN",
    ],
)
def test_variables_of_others_are_left_alone(variable, environment):
    environment(**{variable: "1"})
    settings_of_environment()


def test_every_variable_that_the_project_speaks_of_is_known():
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    paths = [ROOT / name for name in tracked.split("\0") if name and name != "tests/service/test_settings.py"]
    if not paths:
        pytest.skip("not a checkout")
    texts = [path.read_text() for path in paths if path.suffix in (".py", ".md", ".yaml", ".yml", ".toml", ".txt", "")]
    spoken = {name for text in texts for name in re.findall(r"(?<!\w)ROBOSAC_[A-Z0-9]\w*(?<!_)\b(?!\.\.\.)", text)}
    assert len(spoken) > 30
    others = {name for name in spoken if name.removeprefix("ROBOSAC_").lower() not in Settings.model_fields}
    assert others <= set(OTHERS)


def test_a_gateway_with_a_misspelt_variable_does_not_start(environment, capsys):
    environment(ROBOSAC_MAX_SESION="5")
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "service" / "app.py"))
    told = "Error: ROBOSAC_MAX_SESION: there is no such setting; do you mean ROBOSAC_MAX_SESSIONS?"
    assert (ended.value.code, capsys.readouterr().err) == (2, f"{told}\n")
