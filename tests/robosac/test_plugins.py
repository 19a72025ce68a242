"""The one way in which defences, attacks, detectors and scene sources are found."""

import re
import shutil
import subprocess
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol

import pytest

import robosac
from robosac.attacks import ATTACKS, PGD, Attack
from robosac.plugins import Kind, lacks, misfits, parts

FILES = {
    "__init__": "",
    "square": "class Square:\n    name = 'square'\n    def area(self): return 4.0\n",
    "others": (
        "from house.square import Square\n"
        "class Nameless:\n    pass\n"
        "class Sized:\n"
        "    name = 'sized'\n"
        "    def __init__(self, size='1'): self.size = float(size)\n"
        "    def area(self): return self.size\n"
        "class Wall:\n    name = 'wall'\n"
        "class Derived(Sized):\n    pass\n"
        "def fail(): raise KeyError('two\\nlines')\n"
        "def leave(): raise SystemExit(3)\n"
    ),
}


class Shape(Protocol):
    """A shape."""

    def area(self) -> float:
        """Square metres.

        More of it.
        """
        ...


class Room(ABC):
    @abstractmethod
    def door(self):
        """The way in."""

    def window(self):
        return "not needed"


@pytest.fixture
def house(tmp_path, monkeypatch):
    """A package of shapes; the folder that it is in is on Python's path."""
    (tmp_path / "house").mkdir()
    for name, text in FILES.items():
        (tmp_path / "house" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] == "house"]:
        del sys.modules[name]


def shapes(**options):
    return Kind("shape", "house", Shape, **options)


@pytest.mark.usefixtures("house")
def test_the_modules_of_a_package_are_searched_for_classes_with_a_name_of_their_own():
    assert list(shapes().shipped) == ["sized", "wall", "square"]
    assert shapes().make("square").area() == 4.0


def test_a_new_file_is_found(house):
    (house / "house" / "added.py").write_text("class Added:\n    name = 'added'\n    def area(self): return 9.0\n")
    assert shapes().make("added").area() == 9.0


def test_two_of_one_name_are_refused(house):
    (house / "house" / "added.py").write_text("class Added:\n    name = 'square'\n")
    with pytest.raises(ValueError, match=r"two shapes 'square': .*Added.* and .*Square"):
        _ = shapes().shipped


@pytest.mark.usefixtures("house")
def test_an_argument_follows_the_name_where_the_kind_takes_one():
    kind = shapes(takes_argument=True)
    assert kind.make("sized").area() == 1.0
    assert kind.make("sized:2.5").area() == 2.5
    assert kind.make("house.square:Square").area() == 4.0
    with pytest.raises(ValueError, match=r"no shape 'sized:2\.5/x': .*, or what you like"):
        shapes(forms="or what you like").make("sized:2.5/x")


@pytest.mark.usefixtures("house")
@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("nonesuch", "no shape 'nonesuch': give one of sized, square, wall, or module:callable$"),
        ("square:2", "no shape 'square:2': give one of sized, square, wall, or module:callable$"),
        ("wall", r"wall made no shape but a house.others.Wall, which lacks area \(Square metres.\)$"),
        ("house.others:Wall", r"others:Wall made no shape but .* which lacks area"),
        ("house.others:fail", r"^house.others:fail: KeyError: 'two\\nlines'$"),
        ("house.others:nothing", "no attribute 'nothing'"),
        (
            "elsewhere:shape",
            r"No module named 'elsewhere' \(if it is .* PYTHONPATH .*; else give one of sized, square, ",
        ),
        ("house.nowhere:shape", "No module named 'house.nowhere'$"),
        ("house.others:leave", "^house.others:leave: SystemExit: 3$"),
    ],
)
def test_what_cannot_be_had_is_explained_in_a_line(text, complaint):
    with pytest.raises(LookupError, match=complaint) as refused:
        shapes(error=type("Refused", (LookupError, ValueError), {})).make(text)
    assert "\n" not in str(refused.value)


def test_an_installed_package_offers_its_own(house):
    info = house / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[house]\nbrought = house.others:Sized\nsquare = house.others:Sized\n")
    assert shapes().make("brought").area() == 1.0
    assert shapes(takes_argument=True).make("brought:3").area() == 3.0
    assert shapes().make("square").area() == 4.0, "what ships keeps its name"


def test_a_class_asks_for_its_abstract_methods_and_to_be_derived_from():
    assert parts(Room) == {"door": "The way in."}
    assert lacks(7, Room) == "lacks door (The way in.)"
    with pytest.raises(ValueError, match=r"x made no room but 7, which has to derive from Room and lacks door"):
        Kind("room", "house", Room).check(7, Room, "x")


def test_what_cannot_be_called_is_lacking():
    class Flat:
        area = None

    assert lacks(Flat(), Shape) == "lacks area (Square metres.)"
    assert lacks(Flat(), Shape, ["edge"]) == "lacks edge"


def test_a_method_is_called_as_the_contract_says():
    class Scaled:
        def area(self, scale):
            return scale

    told = "has a method area that cannot be called with (): missing a required argument: 'scale'"
    assert misfits(Scaled(), Shape) == told
    assert misfits(SimpleNamespace(area=lambda scale=1: scale), Shape) == ""
    with pytest.raises(ValueError, match=f"x made no shape but .* which {re.escape(told)}$"):
        shapes().check(Scaled(), Shape, "x")


def test_a_method_is_called_as_a_class_that_ships_says_from_which_it_derives():
    class Mine(PGD):
        def objective(self, known, logits):
            return logits.sum()

    told = "has a method objective that cannot be called with (known, logits, delta): too many positional arguments"
    assert misfits(Mine(), Attack) == told
    assert all(misfits(kind(), Attack) == "" for kind in ATTACKS.values())

    class Descending(PGD):
        def optimise(self, surface, attackers, rng, situation, *, terms=(), warm=False):
            return {}

        around = None

    assert "too many positional arguments" in misfits(Descending(), Attack)


def test_a_parameter_that_is_named_is_given_by_its_name():
    class Shape:
        def area(self, *, scale):
            """Square metres."""

    Shape.__module__ = "robosac.shapes"

    class Named(Shape):
        def area(self, *, scale=1):
            return scale

    class Other(Shape):
        def area(self, *, size):
            return size

    assert misfits(Named(), object) == ""
    assert "area" in misfits(Other(), object)


def test_all_parts_of_a_protocol_are_asked_for_those_inherited_too():
    class Solid(Shape, Protocol):
        @property
        def height(self) -> float:
            """Metres."""

    assert parts(Solid) == {"area": "Square metres.", "height": "Metres."}
    assert lacks(7, Solid) == "lacks area (Square metres.), height (Metres.)"


ADDED = {
    "defenses": """
from typing import Literal
from robosac.defenses.halving import Halving

class Halves(Halving):
    kind: Literal["halves"] = "halves"
""",
    "attacks": """
from robosac.attacks import GaussianNoise

class Louder(GaussianNoise):
    name = "louder"
""",
    "detectors": """
from robosac.detectors.embedded import EmbeddedDetector

class Twin(EmbeddedDetector):
    name = "twin"
    opens = ("other-weights",)
""",
    "scenes": """
from robosac.scenes.intersection import Synthetic

class Again(Synthetic):
    kind = "again"
""",
}
USE = """
import json
import sys
import robosac
from safetensors.torch import save_file
from robosac import attacks, defenses, detectors, scenes
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.detectors.weights_file import read_weights

assert robosac.__file__.startswith(sys.argv[1]), robosac.__file__
assert defenses.build({"kind": "halves", "consensus_threshold": 0.4}).consensus_threshold == 0.4
assert type(scenes.SOURCES.make("again")).__name__ == "Again"
assert attacks.load_campaign("louder@asleep").name == "louder"
assert "louder" in attacks.CAMPAIGN_HELP
assert set(detectors.available()) == {"twin", "intersection-mean"}
assert type(detectors.load("twin")).__name__ == "Twin"
tensors, recipe = read_weights(SHIPPED_WEIGHTS)
save_file(tensors, "w.safetensors", metadata={"robosac": json.dumps({**recipe, "detector": "other-weights"})})
assert type(detectors.load("w.safetensors")).__name__ == "Twin"
"""


def test_one_new_file_is_all_that_a_defence_an_attack_a_detector_or_a_scene_source_needs(tmp_path):
    """In a copy of the package, and in a process of its own."""
    copy = tmp_path / "robosac"
    shutil.copytree(Path(robosac.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for package, text in ADDED.items():
        (copy / package / "added.py").write_text(text)
    command = [sys.executable, "-c", USE, str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": "."})
    assert done.returncode == 0, done.stderr
