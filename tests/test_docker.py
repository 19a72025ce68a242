"""No container engine is needed here: what can be read off the files is checked."""

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from string import Template

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def test_every_stage_begins_with_one_image_that_a_digest_names():
    (image,) = [
        value.removeprefix("PYTHON_IMAGE=") for name, value in INSTRUCTIONS if value.startswith("PYTHON_IMAGE=")
    ]
    assert re.fullmatch(r"python:3\.11-slim@sha256:[0-9a-f]{64}", image)
    assert {value.split()[0] for name, value in INSTRUCTIONS if name == "FROM"} == {"${PYTHON_IMAGE}"}


def test_what_is_copied_is_there_and_not_ignored():
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    defaults = dict(value.split("=") for name, value in INSTRUCTIONS if name == "ARG" and "=" in value)
    copied = [value.split()[:-1] for name, value in INSTRUCTIONS if name == "COPY" and "--from" not in value]
    for source in [Template(source).substitute(defaults) for sources in copied for source in sources]:
        assert (ROOT / source).exists()
        assert any(fnmatch(source, pattern) for pattern in kept)


def test_nothing_is_installed_but_what_a_hash_names():
    installs = [value for name, value in INSTRUCTIONS if name == "RUN" and "pip install" in value]
    assert len(installs) == 2
    for command in installs:
        alone = {"--no-index", "--no-deps", "--no-build-isolation", "."} <= set(command.split())
        assert alone or "--require-hashes" in command.split()


def test_the_hashed_requirements_are_those_of_the_project_and_of_its_constraints():
    text = (ROOT / "docker" / "requirements.txt").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    pinned = {}
    for line in lines:
        wanted, *hashes = re.split(r"\s+--hash=", line.strip())
        requirement = Requirement(wanted)
        (version,) = requirement.specifier
        assert version.operator == "=="
        assert hashes
        assert all(re.fullmatch("sha256:[0-9a-f]{64}", one) for one in hashes)
        pinned[canonicalize_name(requirement.name)] = version.version
    constraints = map(Requirement, (ROOT / "constraints.txt").read_text().split())
    tested = {canonicalize_name(one.name): next(iter(one.specifier)).version for one in constraints}
    differing = {name for name in pinned.keys() & tested.keys() if pinned[name] != tested[name]}
    assert not differing
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    build = project["build-system"]["requires"]
    assert project["dependency-groups"]["build"] == build
    for wanted in map(Requirement, [*project["project"]["dependencies"], *extras["postgresql"], *build]):
        assert wanted.specifier.contains(pinned[canonicalize_name(wanted.name)]), wanted


def composed():
    """The service, with the defaults of what the operator's shell may set."""
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", (ROOT / "docker" / "compose.yaml").read_text())
    (service,) = yaml.safe_load(text)["services"].values()
    return service


def test_a_container_may_do_no_more_than_a_gateway_has_to():
    from service.settings import Settings

    service = composed()
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "cap_add" not in service
    assert not service.get("privileged")
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert 0 < float(service["cpus"]) <= 4
    assert 64 <= service["pids_limit"] <= 1024
    memory = int(service["mem_limit"].removesuffix("g")) * 2**30
    assert service["memswap_limit"] == service["mem_limit"]
    settings = Settings()
    assert memory >= settings.max_inflight_bytes + settings.max_pending_bytes + 2**30
    (scratch,) = service["tmpfs"]
    assert re.search(r"^/tmp:size=\d+m,.*noexec,nosuid,nodev", scratch)


def test_compose_builds_this_image_and_sets_known_settings():
    from service.settings import Settings

    service = composed()
    build = service["build"]
    assert (ROOT / "docker" / build["context"] / build["dockerfile"]).samefile(ROOT / "docker" / "Dockerfile")
    assert ":?" in service["environment"]["ROBOSAC_API_KEYS"]  # compose stops where it is not set
    for name in service["environment"]:
        assert re.sub("^ROBOSAC_", "", name).lower() in Settings.model_fields
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
