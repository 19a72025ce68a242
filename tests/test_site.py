"""The documentation as a site: it builds without a warning, and needs no other server when it is read."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from robosac.cli import commands

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, check=False, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


class Loaded(HTMLParser):
    """What a browser loads with a page: not where its links lead."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag != "a" and attrs.get("rel") != "canonical":
            self.addresses += [attrs[name] for name in ("src", "srcset", "href", "data") if attrs.get(name)]


def test_the_pages_load_nothing_from_elsewhere(site):
    pages = [*site.rglob("*.html")]
    assert len(pages) > 20
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text())
        assert len(loaded.addresses) > 3
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name} loads {address}"
            assert page.name == "404.html" or (page.parent / address.split("?")[0].split("#")[0]).exists(), address
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", sheet.read_text()), sheet.name


def test_the_library_and_every_command_are_described(site):
    sessions = (site / "library" / "sessions.html").read_text()
    for name in ("robosac.session.Session.answer", "robosac.fusion.fuse", "robosac.deadline.Deadline"):
        assert f'id="{name}"' in sessions
    page = (site / "commands.html").read_text()
    by_hand = (ROOT / "docs" / "commands.md").read_text()
    for name in commands.places():
        assert f'id="{name}"' in page
        assert f"| `{name}` |" in by_hand
    assert set(re.findall(r"^\| `([a-z-]+)` \|", by_hand, re.MULTILINE)) == set(commands.places())
    assert "--pose-error" in page
    assert 'id="audit-verify"' in page


def test_the_search_works_without_a_server(site):
    assert (site / "search" / "search_index.js").read_text().startswith("var __index")
    assert "iframe-worker.js" in (site / "index.html").read_text()
