"""Whether suspicion is what it says: of teammates with a suspicion of .9, nine in ten should attack."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from robosac import attacks
from robosac.boxes import BoolArray, FloatArray
from robosac.calibration.messages import held
from robosac.calibration.verdicts import STRETCH, Stretch, Trial, validation_stretches
from robosac.defenses.group_testing import Calibration, GroupTesting, GroupTestingSettings
from robosac.detectors import Detector
from robosac.evaluation.playing import play
from robosac.files import write_text
from robosac.scenes import DEFAULT_DATA, SceneSource, first_scenes

RELIABILITY_EDGES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
_STREAM = 43


@dataclass(frozen=True)
class ReliabilityBin:
    """Teammates whose suspicion after two frames lay between two bounds."""

    low: float
    high: float
    teammates: int
    predicted: float
    """Mean suspicion."""
    observed: float
    """Share that did attack."""


@dataclass(frozen=True)
class Reliability:
    """What suspicion after two frames is worth in one world."""

    scenes: int
    honest: int
    """Teammates that do not attack, counted in every stretch."""
    honest_suspected: int
    """Those of them whose suspicion is above one half."""
    attackers: int
    attackers_suspected: int
    bins: tuple[ReliabilityBin, ...]

    @property
    def error(self) -> float:
        """Expected calibration error: mean distance of predicted and observed, bins weighted by teammates."""
        total = sum(each.teammates for each in self.bins)
        return sum(each.teammates * abs(each.predicted - each.observed) for each in self.bins) / max(total, 1)


def check(defense: GroupTesting, stretches: Iterable[Stretch]) -> list[ReliabilityBin]:
    """Suspicion after the frames of each stretch against the truth."""
    return _bins(*_played(defense, stretches))


def check_in(
    detector: Detector,
    calibration: Calibration,
    source: SceneSource,
    scenes: int,
    tick: Callable[[], None] = lambda: None,
) -> Reliability:
    """What suspicion is worth in a world, by the defence as a gateway runs it: default settings, objects judged.

    Attacks and numbers of attackers are those that the calibration was made with; poses are exact.

    Parameters
    ----------
    detector : Detector
    calibration : Calibration
        Of that detector.
    source : SceneSource
        Its validation scenes are played, after as many as the calibration was fitted to: worlds may share numbers of
        scenes. Another source than that of the calibration that has not so many begins with its first.
    scenes : int
        How many.
    tick : callable
        Called after each recorded frame.

    Raises
    ------
    robosac.scenes.SceneError
        If the source has too few scenes, or too short ones, or too small teams.
    ValueError
        If there is no such attack, or the detector lacks what an attack needs.
    """
    made = calibration.recipe
    counts = [int(count) for count in made["attackers"]]
    fitted = int(made["scenes"])
    if source.name != made.get("data", DEFAULT_DATA) and len(source.scenes("validation")) < fitted + scenes:
        fitted = 0
    chosen = first_scenes(source, "validation", fitted + scenes, STRETCH, max(counts))[fitted:]
    trial = Trial({name: attacks.load(name) for name in made["attacks"]}, counts)
    rng = np.random.default_rng([int(made["seed"]), _STREAM])
    defense = GroupTestingSettings().build(calibration)
    suspicion, attacked = _played(defense, validation_stretches(detector, chosen, trial, rng, tick))
    suspected = suspicion > 0.5
    return Reliability(
        scenes=scenes,
        honest=int((~attacked).sum()),
        honest_suspected=int((suspected & ~attacked).sum()),
        attackers=int(attacked.sum()),
        attackers_suspected=int((suspected & attacked).sum()),
        bins=tuple(_bins(suspicion, attacked)),
    )


def add_worlds(path: Path, weights_digest: str, found: Mapping[str, Reliability], command: str) -> None:
    """Put the reliability in worlds into a calibration file; the rest of it stays as it is, other worlds too.

    Raises
    ------
    robosac.defenses.group_testing.CalibrationError
        If the file is no calibration, or belongs to other weights.
    """
    content = held(path, weights_digest)
    worlds = content.setdefault("worlds", {})
    worlds.update({name: {**asdict(each), "command": command} for name, each in found.items()})
    write_text(path, json.dumps(content) + "\n")


def _played(defense: GroupTesting, stretches: Iterable[Stretch]) -> tuple[FloatArray, BoolArray]:
    """Suspicion of each teammate after each stretch, and whether it attacked in its last frame."""
    suspicion: list[float] = []
    attacked: list[bool] = []
    for index, (_, stretch) in enumerate(stretches):
        *_, last = play(defense, stretch, np.random.default_rng(index))
        for name, suspected in (last.result.suspicion or {}).items():
            suspicion.append(suspected)
            attacked.append(name in stretch[-1].attackers)
    return np.array(suspicion), np.array(attacked, dtype=bool)


def _bins(suspicion: FloatArray, attacked: BoolArray) -> list[ReliabilityBin]:
    bins = []
    for low, high in pairwise(RELIABILITY_EDGES):
        inside = (suspicion >= low) & ((suspicion < high) | (high == 1.0))
        if inside.any():
            mean, share = float(suspicion[inside].mean()), float(attacked[inside].mean())
            bins.append(ReliabilityBin(low, high, int(inside.sum()), mean, share))
    return bins
