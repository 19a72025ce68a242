from collections.abc import Callable

import pytest

from robosac.detectors import EmbeddedDetector
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.frames import EvaluationFrame
from robosac.scenes import IntersectionScene


@pytest.fixture(scope="session")
def played(detector: EmbeddedDetector) -> Callable[..., list[EvaluationFrame]]:
    """The first frames of a scene under a campaign, for all that ask: attacks that pretend take seconds a frame."""
    encounters, known = Encounters(detector, IntersectionScene(2)), {}

    def frames(spec: str, count: int, attackers: tuple[str, ...] = ("car-3",)) -> list[EvaluationFrame]:
        if (spec, count, attackers) not in known:
            known[spec, count, attackers] = encounters.sequence(count, spec, attackers)
        return known[spec, count, attackers]

    return frames
