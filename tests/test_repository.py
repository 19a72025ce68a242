import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parent.parent
README, CONTRIBUTING = ((ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version_and_licence():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(citation["version"]) == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert len(citation["references"][0]["authors"]) == 6


def test_the_changelog_knows_this_version():
    versions = re.findall(r"^## \[([\d.]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == PROJECT["version"]


def test_the_readme_finds_its_way():
    """Every name of its list is a module or a folder where the list says, and no package is left out."""
    (listed,) = re.findall(r"## Find your way\n\n```\n(.*?)```", README, re.DOTALL)
    folder, named = ROOT, []
    for line in listed.splitlines():
        indented, name = re.match(r"( *)([\w/]+)", line).groups()
        if not indented:
            names = re.findall(r"(?:^|  )([\w-]+)/", line)
            folder = ROOT / names[0]
            named += [ROOT / each for each in names]
        else:
            named.append(folder / name if name.endswith("/") else folder / f"{name}.py")
    assert len(named) > 30
    assert not [path for path in named if not path.exists()]
    packages = {path.parent for package in ("robosac", "service") for path in ROOT.glob(f"{package}/*/__init__.py")}
    assert packages <= set(named)


def test_the_map_of_changes_leads_to_files_that_are_there():
    paths = set(re.findall(r"`((?:robosac|service|clients|tests|docs|benchmarks)/[\w/.-]+)`", CONTRIBUTING))
    paths |= {path for command in re.findall(r"`pytest ([^`]+)`", CONTRIBUTING) for path in command.split()}
    assert len(paths) > 20
    assert not {path for path in paths if not (ROOT / path).exists() and not (ROOT / f"{path}.py").exists()}


def test_what_make_can_do_is_what_its_help_says():
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^\.PHONY: (.*)", makefile, re.MULTILINE)[0].split())
    assert set(re.findall(r'@echo "make ([a-z]+) ', makefile)) == targets - {"help", "format", "clean"}


def test_links_of_the_pages_lead_somewhere():
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")]
    headings = {
        page.resolve(): {
            re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-")
            for heading in re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
        }
        for page in pages
    }
    broken = []
    for page in pages:
        for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text()):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page.resolve()
            if not target.exists() or (anchor and anchor not in headings.get(target, set())):
                broken.append(f"{page.name}: {link}")
    assert not broken


def test_the_bound_on_torch_is_explained_and_is_that_of_the_tested_version():
    """The tests run with the version of the constraints; the next minor one is not allowed yet, and it is said why."""
    (tested,) = re.findall(r"^torch==(\d+)\.(\d+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    (bound,) = [name for name in PROJECT["dependencies"] if name.startswith("torch")]
    assert bound.endswith(f",<{tested[0]}.{int(tested[1]) + 1}")
    newest = ".".join(tested)
    assert re.search(
        rf"# {newest} is the newest .*\n.*\n *\"{re.escape(bound)}\"", (ROOT / "pyproject.toml").read_text()
    )
    assert f"`<{bound.rpartition('<')[2]}`, as {newest} is the newest" in README
