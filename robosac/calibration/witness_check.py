"""How well a witness knows places that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from robosac.boxes import FloatArray
from robosac.calibration.places import OBSERVED_HITS
from robosac.calibration.witness import Lesson
from robosac.defenses.group_testing.claims import DENIES, SUPPORTS
from robosac.detectors.witness import Witness, as_testimony


@dataclass(frozen=True)
class WitnessCheck:
    """Shares of places, in [0, 1], and distances in metres."""

    places: int
    free_denied: float
    """Of observed places without a vehicle, those that are denied."""
    free_supported: float
    """Of all places without a vehicle, those where one is supported."""
    vehicles_supported: float
    """Of observed vehicles, those that are supported."""
    vehicles_denied: float
    """Of all vehicles, those that are denied: what an honest teammate may be contradicted by."""
    off_along_m: float
    off_across_m: float
    """How far observed vehicles are from where they are seen, along and across themselves, the mean."""


def check(witness: Witness, held_out: Sequence[Lesson]) -> WitnessCheck:
    """Ask a witness about lessons that it was not given."""
    said: list[FloatArray] = []
    off: list[FloatArray] = []
    for lesson in held_out:
        with torch.inference_mode():
            maps = witness.read(witness.layout.scaled(lesson.map[None].float()), [lesson.height_m]).half().numpy()
        testimony = as_testimony(("",), maps, np.eye(3)[None], witness.layout.half_extent_m)
        said.append(testimony.likelihood(lesson.places.at)[0])
        box = lesson.places.box[lesson.places.observed_vehicles]
        d = testimony.sighting(box[:, :2]).centre[0] - box[:, :2]
        cos, sin = np.cos(box[:, 4]), np.sin(box[:, 4])
        off.append(np.stack([d[:, 0] * cos + d[:, 1] * sin, d[:, 1] * cos - d[:, 0] * sin], axis=1))
    likelihood = np.concatenate(said)
    vehicle = np.concatenate([lesson.places.vehicle for lesson in held_out]) > 0
    observed = np.concatenate([lesson.places.hits for lesson in held_out]) >= OBSERVED_HITS
    along, across = np.abs(np.concatenate(off)).mean(axis=0)
    return WitnessCheck(
        len(likelihood),
        float((likelihood[~vehicle & observed] <= DENIES).mean()),
        float((likelihood[~vehicle] >= SUPPORTS).mean()),
        float((likelihood[vehicle & observed] >= SUPPORTS).mean()),
        float((likelihood[vehicle] <= DENIES).mean()),
        float(along),
        float(across),
    )
