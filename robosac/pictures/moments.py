"""Frames of a sequence under attack, as a defence answered them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robosac.answers import FrameAnswer
from robosac.boxes import FloatArray
from robosac.consensus import at_least
from robosac.defenses import DefenseSettings
from robosac.detectors import Detector
from robosac.evaluation.comparison.playing import attackers
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.frames import DecodedOnce, another_scene
from robosac.evaluation.playing import play
from robosac.fusion import FusionResult
from robosac.scenes import Scene, SceneSource
from robosac.session import defense_for


@dataclass(frozen=True)
class Scenario:
    """What is played: the first frames of a test scene, as its first ego meets them."""

    detector: Detector
    source: SceneSource
    scene: Scene
    campaign: str
    """As `robosac.attacks.load_campaign` takes it."""
    attackers: int
    """Drawn among the ego's teammates, as a comparison of the same seed draws them."""
    frames: int
    seed: int = 0
    pose_error_m: float = 0.0

    @property
    def ego_id(self) -> str:
        """Whose answers they are."""
        return self.scene.egos[0]

    @cached_property
    def controlled(self) -> tuple[str, ...]:
        """Teammates that are under the adversary's control."""
        return tuple(attackers(self.scene, self.attackers, self.seed))

    @property
    def title(self) -> str:
        """Which scene, and who is made to attack how."""
        scene = f"{self.source.name}, scene {self.scene.number}"
        if not self.attackers:
            return scene
        verb = "attacks" if self.attackers == 1 else "attack"
        return f"{scene}: {', '.join(sorted(self.controlled))} {verb} by {self.campaign}"

    def met(self, tick: Callable[[], None] = lambda: None) -> list[DecodedOnce]:
        """The frames, attacked. ``tick`` is called after each."""
        other = another_scene(self.source, "test", self.scene)
        encounters = Encounters(self.detector, self.scene, self.seed, self.pose_error_m, other)
        return [DecodedOnce.of(f) for f in encounters.sequence(self.frames, self.campaign, self.controlled, tick)]


@dataclass(frozen=True)
class Moment:
    """One frame, and what came of it."""

    number: int
    ego_id: str
    met: DecodedOnce
    result: FusionResult

    @cached_property
    def answer(self) -> FrameAnswer:
        """As it would be sent."""
        return self.result.answer(self.number, {}, {}, self.ego_id)

    @property
    def named(self) -> tuple[str, ...]:
        """Teammates held to be attackers in this frame."""
        return self.result.named or ()

    @property
    def found(self) -> FloatArray:
        """Boxes (n, 6) of the answer from the consensus score on."""
        return at_least(self.result.boxes, self.met.info.consensus_score)

    def fused(self, *subset: str) -> FloatArray:
        """Boxes (n, 6) of a fusion from the consensus score on; without teammates those that the ego sees alone."""
        return self.met.confident(subset)


def moments(sequence: Scenario, met: list[DecodedOnce], settings: DefenseSettings) -> list[Moment]:
    """Answer frames one after another as a session does.

    Parameters
    ----------
    sequence : Scenario
    met : list of DecodedOnce
        Its frames. What was decoded of them for another defence is not decoded again.
    settings : DefenseSettings

    Raises
    ------
    robosac.budget.DomainError
        If the settings make no sense for the detector.
    robosac.evaluation.playing.FaultyDefense
        If the defence fails.
    """
    decided = settings.at_period(sequence.scene.frame_period_s * 1e3)
    defense = defense_for(decided, sequence.detector.info)
    rng = np.random.default_rng([sequence.seed, sequence.scene.number, zlib.crc32(settings.kind.encode())])
    answers = play(defense, met, rng)
    pairs = enumerate(zip(met, answers, strict=True))
    return [Moment(index, sequence.ego_id, frame, answer.result) for index, (frame, answer) in pairs]
