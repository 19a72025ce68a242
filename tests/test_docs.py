import asyncio
import csv
import hashlib
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import robosac
from clients.local_gateway import local_gateway
from clients.simulation import Fleet
from robosac import attacks, defenses, detectors, plugins
from robosac.cli import app
from robosac.detectors import Message
from robosac.wire import content_digest
from service.errors import Kind
from service.problems import ANSWERS
from service.settings import Settings
from tests.service.conftest import serve

ROOT = Path(__file__).parents[1]


def test_every_setting_is_documented_with_its_default():
    text = (ROOT / "docs" / "settings.md").read_text()
    rows = dict(re.findall(r"^\| `ROBOSAC_(\w+)` \| `?([^|`]+?)`? \|", text, re.MULTILINE))
    assert {name.lower() for name in rows} == set(Settings.model_fields)
    for name, shown in rows.items():
        default = getattr(Settings(), name.lower())
        assert str("none" if default in ((), None) else default).removesuffix(".0") == shown


async def test_the_session_of_the_api_page_can_be_opened():
    text = (ROOT / "docs" / "api.md").read_text()
    (block,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    async with serve() as served:
        response = await served.http.post("/v1/sessions", json=json.loads(block))
        assert response.status_code == 201, response.text


def test_the_digest_of_the_api_page_is_what_is_computed():
    text = (ROOT / "docs" / "api.md").read_text()
    (block,) = re.findall(r"^```text\n(0000.*?)\nsha256 ([0-9a-f]{64})\n```", text, re.MULTILINE | re.DOTALL)
    hashed, told = block
    pose = np.eye(4)
    pose[2, 3] = 2.0
    message = Message(pose, {"map": np.array([[[0.5, -1.0], [0.0, 2.0]]], dtype=np.float16)})
    assert told == content_digest(7, "car-2", message)
    assert told == hashlib.sha256(bytes.fromhex(hashed.replace("\\", ""))).hexdigest()


def test_every_attack_that_ships_has_its_row():
    text = (ROOT / "docs" / "own-attack.md").read_text()
    assert not {name for name in attacks.ATTACKS if f"`{name}`" not in text}


def test_links_between_pages_lead_somewhere():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_library_page_knows_every_name_that_a_newcomer_imports():
    text = (ROOT / "docs" / "library" / "index.md").read_text()
    assert not {name for name in robosac.__all__ if f"`robosac.{name}`" not in text}


def test_every_problem_and_reason_is_documented():
    assert set(ANSWERS) == set(Kind)
    table = (ROOT / "docs" / "api.md").read_text().partition("## Problems")[2]
    rows = [line.split("|")[1:3] for line in table.splitlines() if line.startswith("| `")]
    told = {slug: statuses for slugs, statuses in rows for slug in re.findall("`([a-z-]+)`", slugs)}
    for kind, (status, _) in ANSWERS.items():
        assert str(status) in told[kind.value], kind
    wire = "".join(path.read_text() for path in sorted((ROOT / "robosac" / "wire").glob("*.py")))
    codes = set(re.findall(r'WireError\(\s*"([a-z-]+)"', wire))
    assert len(codes) > 5
    assert codes <= set(told)


def test_the_table_of_defences_is_what_they_say_of_themselves():
    text = (ROOT / "docs" / "api.md").read_text()
    for kind, model in defenses.shipped().items():
        settings = {name: field.default for name, field in model.model_fields.items() if name != "kind"}
        said = ", ".join(f"`{n}`" + ("" if default is None else f" ({default})") for n, default in settings.items())
        assert f"| `{kind}` | {model.summary()} | {said} |\n" in text


def test_the_page_on_defences_knows_all_that_one_has_to_have():
    text = (ROOT / "docs" / "own-defense.md").read_text()
    (table,) = re.findall(r"^\| it has .*?\n\n", text, re.MULTILINE | re.DOTALL)
    for part in plugins.parts(defenses.Defense):
        assert f"`{part}" in table


@pytest.fixture
def examples(tmp_path, monkeypatch):
    """The whole examples of the pages on one's own detector, attack and defence, importable."""
    for name in ("detector", "attack", "defense"):
        (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / f"own-{name}.md").read_text(), re.DOTALL)
        (tmp_path / f"my_{name}.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("examples")
def test_the_examples_of_the_pages_can_be_evaluated():
    common = ["evaluate", "--scenes", "1", "--frames", "1"]
    for option in (["--detector", "my_detector:build"], ["--attack", "my_attack:Suppress"]):
        result = CliRunner().invoke(app, [*common, *option])
        assert result.exit_code == 0, result.output


async def test_the_programs_of_the_readme_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("ROBOSAC_LATENCY_BUDGET_MS", "5000")  # the machine of the tests may be busy
    client, library = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    async with local_gateway(tmp_path / "gateway.log") as url:
        await asyncio.to_thread(exec, client.replace("http://127.0.0.1:8000", url), {"__name__": "client"})
    answer, best, *told = capsys.readouterr().out.splitlines()
    assert answer.startswith("consensus ('car-2', 'car-3', 'car-4', 'car-5', 'rsu') ")
    assert best.startswith("the best of them, in the world: [")
    opened, answered = told
    assert opened.startswith("car-1 opened a session with car-2, car-3, car-4, car-5 and rsu; the detector is ")
    assert answered.startswith("Frame 0 was answered with ")
    exec(library.replace("Session(detector, team)", "Session(detector, team, rng=np.random.default_rng(0))"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert lines[-1].endswith("accepted ('car-3', 'car-4', 'car-5', 'rsu') named ('car-2',)")


def test_the_first_half_hour_goes_as_told(tmp_path, monkeypatch, capsys):
    session, attack, swapped = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.DOTALL
    )
    (tmp_path / "one_step.py").write_text(attack)
    monkeypatch.syspath_prepend(tmp_path)
    honest, _, pgd = session.rpartition("play(range(3, 6), robosac.PGD())")
    assert pgd == "\n"
    for attacked in ("play(range(3, 6), robosac.PGD())", swapped):
        seeded = honest.replace("Session(detector, team)", "Session(detector, team, rng=np.random.default_rng(0))")
        assert seeded != honest
        exec(seeded + attacked, {"__name__": "first_session"})
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 6
        assert all(line.endswith("named ()") for line in lines[:3])
        assert lines[-1].endswith("accepted ('car-3', 'car-4', 'car-5', 'rsu') named ('car-2',)")
    options = ["evaluate", "--attack", "one_step:OneStep", "--scenes", "1", "--frames", "1", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "bounds.json").read_text())["miss_rate"] == 0.0


@pytest.mark.usefixtures("examples")
def test_an_attack_on_boxes_needs_a_detector_that_shows_them():
    options = ["evaluate", "--scenes", "1", "--frames", "1", "--detector", "my_detector:build", "--attack", "shift"]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 2
    assert "perceive" in result.output


@pytest.mark.usefixtures("examples")
async def test_the_gateway_serves_the_example_detector_and_fuses_as_the_library_does():
    detector, attack = detectors.load("my_detector:build"), attacks.load("my_attack:Suppress")
    scene = robosac.IntersectionScene(3)
    (frame,) = Fleet(scene, detector, 1, 1, attack, seed=0).sense(0)
    async with serve(itertools.repeat(5), extra_detectors="my_detector:build") as served:
        listed = (await served.http.get("/v1/detectors")).json()["detectors"]
        assert [entry["name"] for entry in listed] == ["intersection-mean", "occupancy-max"]
        session = await served.open(detector="occupancy-max")
        answer = await served.ego(session).post_frame(0, frame.message, frame.sent)
    rng = np.random.default_rng(5)
    expected = robosac.fuse(detector, robosac.SampleConsensus(), frame.message, frame.sent, rng=rng)
    assert answer.accepted == expected.accepted
    np.testing.assert_allclose(answer.boxes, expected.boxes)
    assert len(expected.boxes) > 5


@pytest.mark.usefixtures("examples")
def test_the_example_defence_can_be_compared(tmp_path):
    options = ["compare", "--out", str(tmp_path), "--only", "one_by_one", "--defense", "my_defense:RunningScore"]
    result = CliRunner().invoke(app, [*options, "--setting", "pgd:1", "--scenes", "1", "--frames", "6"])
    assert result.exit_code == 0, result.output
    with (tmp_path / "comparison.csv").open() as file:
        rows = {line["defense"]: line for line in csv.DictReader(file)}
    own = rows["my_defense:RunningScore"]
    assert set(rows) == {"oracle", "one_by_one", "my_defense:RunningScore", "ego only"}
    assert float(own["ap50"]) > float(rows["ego only"]["ap50"]) + 0.05
    assert float(own["infiltrated"]) == 0.0
    assert (own["attackers_named"], own["honest_named"]) == ("1", "0")
    assert "--defense my_defense:RunningScore" in (tmp_path / "comparison.md").read_text()


@pytest.mark.usefixtures("examples")
@pytest.mark.parametrize(
    ("name", "complaint"),
    [("my_defense:START", "not callable"), ("halving", "has its column"), ("nonesuch", "give one")],
)
def test_what_cannot_be_compared_is_explained(name, complaint, tmp_path):
    result = CliRunner().invoke(app, ["compare", "--out", str(tmp_path / "out"), "--defense", name])
    assert result.exit_code == 2
    assert complaint in " ".join(result.output.replace("│", "").split())


@pytest.mark.usefixtures("examples")
async def test_the_gateway_serves_the_example_defence_and_its_decisions_can_be_replayed(
    ego_message, attacked, tmp_path, monkeypatch
):
    async with serve(extra_defenses="my_defense:RunningScore", keep_frames=9) as served:
        session = await served.open(defense={"kind": "running_score", "keep": 0.5})
        ego = served.ego(session)
        answers = [await ego.post_frame(i, ego_message, attacked) for i in range(3)]
        assert all(set(answer.accepted) == {"car-3", "car-4", "car-5", "rsu"} for answer in answers)
        assert (await ego.state())["state"]["named"] == ["car-2"]
        (tmp_path / "frame").write_bytes(await ego.kept_messages(2))
        (tmp_path / "log").write_text("".join(line + "\n" for line in await ego.audit_lines()))
    monkeypatch.chdir(tmp_path)
    command = ["audit", "replay", "log", "--messages", "frame"]
    told = CliRunner().invoke(app, [*command, "--defense", "my_defense:RunningScore"])
    assert told.exit_code == 0, told.output
    assert "the same decision: consensus" in told.output
    untold = CliRunner().invoke(app, command)
    assert untold.exit_code == 2
    assert "no defence of kind 'running_score'" in " ".join(untold.output.replace("│", "").split())
    wrong = CliRunner().invoke(app, [*command, "--defense", "my_defense:Nonesuch"])
    assert wrong.exit_code == 2
    assert "has no attribute 'Nonesuch'" in " ".join(wrong.output.replace("│", "").split())
