"""Calibrate a detector for group testing: collect verdicts, fit likelihoods, check them on scenes held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from robosac import attacks
from robosac.attacks import Attack
from robosac.calibration.fit import TooFewVerdicts, fit
from robosac.calibration.reliability import ReliabilityBin, check
from robosac.calibration.verdicts import STRETCH, STRETCH_STRIDE, Stretch, Trial, collect, validation_stretches
from robosac.defenses.group_testing import Calibration, EvidenceModel, GroupTesting
from robosac.defenses.group_testing.geometry import MIN_WITNESSES, WITNESS_SCORE
from robosac.detectors import Detector
from robosac.scenes import DEFAULT_DATA, Scene, first_scenes, load_source

_STREAM = 41
_CHECK = 1


@dataclass(frozen=True)
class Recipe:
    """What a calibration is made from."""

    attacks: tuple[str, ...] = ("pgd", "erase", "invent", "shift")
    """Names of `robosac.attacks.ATTACKS`, or ``module:callable``; each is a kind."""
    attackers: tuple[int, ...] = (1, 2)
    """Each attack comes with each of these numbers of attackers; a number from 2 on must be among them."""
    scenes: int = 128
    stretches_per_scene: int = 1
    """The first validation scenes, and stretches of two successive frames of each."""
    check_scenes: int = 12
    """The scenes after them, for the reliability."""
    pose_errors_m: tuple[float, ...] = (0.0, 0.2, 0.4)
    """Ascending; a level each."""
    seed: int = 0
    data: str = DEFAULT_DATA
    """As `robosac.scenes.load_source` takes it."""

    def __post_init__(self) -> None:
        if not self.attacks or not self.attackers or not self.pose_errors_m:
            raise ValueError("attacks, attackers and pose errors must not be empty")
        if min(self.attackers) < 1 or min(self.pose_errors_m) < 0:
            raise ValueError("attackers must be at least 1, pose errors at least 0")
        if max(self.attackers) < 2:
            raise ValueError("attackers must hold 2 or more: a calibration has to show what two do together")
        if self.scenes < 1 or self.check_scenes < 0:
            raise ValueError("scenes must be at least 1, check_scenes at least 0")

    @property
    def frames_per_level(self) -> int:
        """Recorded frames of a level, those of the check among them."""
        frames = (self.scenes + self.check_scenes) * self.stretches_per_scene * STRETCH
        return frames * (1 + len(self.attacks) * len(self.attackers))


def calibrate(
    detector: Detector, recipe: Recipe, command: str, tick: Callable[[], None] = lambda: None
) -> tuple[Calibration, dict[float, list[ReliabilityBin]]]:
    """Make the calibration of a detector, and its reliability by level of pose error.

    The reliability is that of the suspicion after the second frame of a session, on scenes that the tables were not
    fitted to; attacks and numbers of attackers are those of the recipe.

    Parameters
    ----------
    detector : Detector
    recipe : Recipe
    command : str
        To make it again; kept with it.
    tick : callable
        Called after each recorded frame.

    Raises
    ------
    ValueError
        If there is no such attack or data, or the detector lacks what an attack needs.
    robosac.scenes.SceneError
        If the data have too few scenes, or too short ones, or too small teams.
    robosac.calibration.fit.TooFewVerdicts
        If the scenes do not show all that is needed.
    """
    chosen = load_attacks(detector, recipe.attacks)
    scenes = _scenes(recipe)
    levels: list[EvidenceModel] = []
    reliability: dict[float, list[ReliabilityBin]] = {}
    for number, error in enumerate(sorted(recipe.pose_errors_m)):
        trial = Trial(chosen, recipe.attackers, error, recipe.stretches_per_scene)

        def stretches(part: Sequence[Scene], *stream: int, trial: Trial = trial) -> Iterator[Stretch]:
            rng = np.random.default_rng([recipe.seed, _STREAM, *stream])
            return validation_stretches(detector, part, trial, rng, tick)

        verdicts = collect(stretches(scenes[: recipe.scenes], number))
        try:
            model = fit(verdicts, recipe.attacks, error)
        except TooFewVerdicts as few:
            # had it happened in one scene of as many, three times as many would have shown it with 95 %
            told = f"{recipe.scenes} are too few ({few}): try {3 * recipe.scenes}"
            if "attackers among the joined" in str(few):
                told += f". A fusion is judged by its boxes of score {WITNESS_SCORE}: where an attack leaves fewer than"
                told += f" {MIN_WITNESSES} of them, no number of scenes will do"
            raise TooFewVerdicts(told) from few
        levels.append(model)
        reliability[error] = check(GroupTesting(model), stretches(scenes[recipe.scenes :], number, _CHECK))
    made_by = {
        "command": command,
        **asdict(recipe),
        "attack_settings": {name: _settings(attack) for name, attack in chosen.items()},
        "reliability": {f"{error:g}": [asdict(b) for b in bins] for error, bins in reliability.items()},
    }
    info = detector.info
    return Calibration(info.name, info.weights_digest, made_by, tuple(levels)), reliability


def load_attacks(detector: Detector, names: Sequence[str]) -> dict[str, Attack]:
    """Attacks to calibrate a detector with, by the names of a recipe.

    Raises
    ------
    ValueError
        If there is no such attack, or the detector lacks what one needs; the message says which others are possible.
    """
    chosen = {name: attacks.load(name) for name in names}
    faults = {name: fault for name, attack in chosen.items() if (fault := attacks.lacking(attack, detector))}
    if faults:
        others = ", ".join(name for name in chosen if name not in faults)
        said = f". It can be calibrated with the others: {others}" if others else ""
        raise ValueError("; ".join(faults.values()) + said)
    return chosen


def _scenes(recipe: Recipe) -> list[Scene]:
    """Those to fit to, and after them those to check on."""
    frames = STRETCH_STRIDE * (recipe.stretches_per_scene - 1) + STRETCH
    source, count = load_source(recipe.data), recipe.scenes + recipe.check_scenes
    return first_scenes(source, "validation", count, frames, max(recipe.attackers))


def _settings(attack: Attack) -> Mapping[str, float]:
    return dict(vars(attack))
