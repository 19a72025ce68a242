from pathlib import Path

import numpy as np
import pytest
import torch

from robosac.detectors import EmbeddedDetector, Message
from robosac.recording.content import Moment
from robosac.scenes import IntersectionScene, SceneFrame
from tests.recorded import moments

GOLDEN = Path(__file__).parent / "golden"

LONGEST = (
    *("test_own", "test_docs", "test_site", "test_training", "test_experiments"),
    *("test_benchmarks", "test_words", "test_worlds", "test_remembering"),
)
"""Files that take long come first, or one process would be left with the last of them while the other has none."""

torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in LONGEST)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2024)


@pytest.fixture(scope="session")
def detector() -> EmbeddedDetector:
    return EmbeddedDetector()


@pytest.fixture(scope="session")
def scene_frame() -> SceneFrame:
    return IntersectionScene(seed=3).frame(0)


@pytest.fixture(scope="session")
def messages(detector: EmbeddedDetector, scene_frame: SceneFrame) -> dict[str, Message]:
    """Benign messages of all six agents in one frame."""
    return {name: detector.encode(view.points, view.pose) for name, view in scene_frame.views.items()}


@pytest.fixture(scope="session")
def ego_message(messages: dict[str, Message]) -> Message:
    return messages["car-1"]


@pytest.fixture(scope="session")
def benign(messages: dict[str, Message]) -> dict[str, Message]:
    """Messages of the five teammates of car-1."""
    return {name: message for name, message in messages.items() if name != "car-1"}


@pytest.fixture(scope="session")
def attacked(detector: EmbeddedDetector, ego_message: Message, benign: dict[str, Message]) -> dict[str, Message]:
    """The same with car-2 attacking by PGD."""
    from robosac.attacks import PGD

    surface = detector.attack_surface(ego_message, benign)
    adversarial = PGD().run(surface, ["car-2"], np.random.default_rng(0))
    return {**benign, "car-2": detector.perturbed(benign["car-2"], adversarial["car-2"])}


@pytest.fixture(scope="session")
def recorded_moments(detector: EmbeddedDetector) -> list[Moment]:
    """Six frames as a session decides them, to be recorded; car-2 attacks."""
    return list(moments(detector, range(6), attacker="car-2"))
