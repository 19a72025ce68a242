"""No container engine is needed here: what can be read off the files is checked."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
LINES = (ROOT / "docker" / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
INSTRUCTIONS = [line.split(maxsplit=1) for line in LINES if line and not line.startswith("#")]
FINAL = INSTRUCTIONS[max(i for i, (name, _) in enumerate(INSTRUCTIONS) if name == "FROM") :]


def test_the_image_is_built_in_stages_and_runs_without_root():
    assert [name for name, _ in INSTRUCTIONS].count("FROM") == 2
    names = [name for name, _ in FINAL]
    (user,) = [value for name, value in FINAL if name == "USER"]
    assert user not in ("root", "0")
    assert names.index("USER") < names.index("CMD")
    assert "HEALTHCHECK" in names


def test_what_is_copied_is_there_and_not_ignored():
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = [value.split()[:-1] for name, value in INSTRUCTIONS if name == "COPY" and "--from" not in value]
    for source in [source for sources in copied for source in sources]:
        assert (ROOT / source).exists()
        assert source in kept


def test_compose_builds_this_image_and_sets_known_settings():
    from service.settings import Settings

    (service,) = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"].values()
    build = service["build"]
    assert (ROOT / "docker" / build["context"] / build["dockerfile"]).samefile(ROOT / "docker" / "Dockerfile")
    assert ":?" in service["environment"]["ROBOSAC_API_KEYS"]  # compose stops where it is not set
    for name in service["environment"]:
        assert re.sub("^ROBOSAC_", "", name).lower() in Settings.model_fields
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
