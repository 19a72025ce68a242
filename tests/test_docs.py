import json
import re
from pathlib import Path

from service.settings import Settings
from tests.service.conftest import serve

ROOT = Path(__file__).parents[1]


def test_every_setting_is_documented_with_its_default():
    text = (ROOT / "docs" / "running.md").read_text()
    rows = dict(re.findall(r"^\| `ROBOSAC_(\w+)` \| `?([^|`]+?)`? \|", text, re.MULTILINE))
    assert {name.lower() for name in rows} == set(Settings.model_fields)
    for name, shown in rows.items():
        default = getattr(Settings(), name.lower())
        assert str(default).removesuffix(".0") == shown


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
