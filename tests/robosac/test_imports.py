import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pkgutil import iter_modules

import pytest

import robosac

HEAVY = ("torch", "torch._dynamo", "scipy", "matplotlib")


def loaded_by(code: str) -> set[str]:
    """Which of the heavy packages a fresh interpreter has loaded after some code."""
    show = f"import sys; print(*(name for name in {HEAVY} if name in sys.modules))"
    run = subprocess.run([sys.executable, "-c", f"{code}\n{show}"], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize(
    "code",
    [
        "import clients.client",
        "from robosac import Message",
        "from robosac.detectors import Detector, Message, TensorSpec",
        "from robosac import IntersectionScene",
        "from robosac import SampleConsensus",
        "from robosac.audit import verify",
        "import service.settings",  # so that a wrong one is told at once
    ],
)
def test_light_things_are_light_to_import(code):
    assert loaded_by(code) == set()


def test_fusion_has_loaded_all_that_a_frame_needs():
    # match() imports scipy in its rare branch; inside a frame that would cost a second
    assert "scipy" in loaded_by("import robosac.fusion")


def test_an_attack_does_without_the_compiler_of_torch():
    code = """
import torch
from robosac.attacks import PGD
variable = torch.ones(3)
variable.grad = torch.tensor([1.0, 0.0, -2.0])
PGD(step_size=0.5).optimiser([variable]).step()
assert variable.tolist() == [0.5, 1.0, 2.0]
"""
    assert loaded_by(code) == {"torch"}


@pytest.mark.parametrize("package", ["robosac", "robosac.detectors"])
def test_every_public_name_is_there_and_listed(package):
    code = f"""
import {package} as package
from {package} import *
missing = [name for name in package.__all__ if name not in globals() or name not in dir(package)]
assert not missing, missing
again = [name for name in package.__all__ if name not in vars(package)]
assert not again, again
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_version_is_that_of_the_installation():
    assert robosac.__version__ == version("robosac")


@pytest.mark.parametrize("package", ["robosac", "robosac.detectors"])
def test_a_name_that_is_not_there_is_told(package):
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nonesuch'"):
        import_module(package).nonesuch  # noqa: B018


@pytest.mark.parametrize("package", ["robosac", "robosac.detectors"])
def test_no_public_name_is_that_of_a_module(package):
    """Once the module is imported, the name would mean the module."""
    found = import_module(package)
    assert {module.name for module in iter_modules(found.__path__)}.isdisjoint(found.__all__)
