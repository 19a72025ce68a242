import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import robosac
from clients.simulation import Fleet
from robosac import attacks, detectors
from robosac.cli import app
from service.settings import Settings
from tests.service.conftest import serve

ROOT = Path(__file__).parents[1]


def test_every_setting_is_documented_with_its_default():
    text = (ROOT / "docs" / "running.md").read_text()
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


def test_links_between_pages_lead_somewhere():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_problem_and_reason_is_documented():
    text = (ROOT / "docs" / "api.md").read_text()
    sources = [*(ROOT / "service").glob("*.py"), ROOT / "robosac" / "wire.py"]
    code = "\n".join(path.read_text() for path in sources)
    slugs = set(re.findall(r'(?:Problem\(\s*\d{3},\s*|WireError\(\s*)"([a-z-]+)"', code))
    assert len(slugs) > 15
    assert not {slug for slug in slugs if f"`{slug}`" not in text}


@pytest.fixture
def examples(tmp_path, monkeypatch):
    """The whole examples of the pages on one's own detector and attack, importable."""
    for name in ("detector", "attack"):
        (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / f"own-{name}.md").read_text(), re.DOTALL)
        (tmp_path / f"my_{name}.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("examples")
def test_the_examples_of_the_pages_can_be_evaluated():
    common = ["evaluate", "--scenes", "1", "--frames", "1"]
    for option in (["--detector", "my_detector:build"], ["--attack", "my_attack:Suppress"]):
        result = CliRunner().invoke(app, [*common, *option])
        assert result.exit_code == 0, result.output


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
