"""The fleet's side of the world: what every vehicle senses, and what an attacker sends instead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robosac.attacks import Attack, Campaign
from robosac.attacks.situation import Lie, Past
from robosac.boxes import FloatArray
from robosac.detectors import Detector, Message
from robosac.evaluation.frames import (
    Sensed,
    encode_all,
    foreign_views,
    hostile_in,
    under_attack,
    vehicles_around,
)
from robosac.scenes import Frame, Scene


@dataclass(frozen=True)
class EgoFrame:
    """One frame from one ego's side."""

    scene: int
    """The scene's number."""
    ego_id: str
    attackers: frozenset[str]
    """Those whose message of this frame is not what an honest one would send."""
    benign: Mapping[str, Message]
    sent: Mapping[str, Message]
    """What each teammate really sends to this ego."""
    message: Message
    """The ego's own message."""
    truth: FloatArray
    """(G, 5); ego frame."""
    points: FloatArray
    """(P, 3); the ego's LiDAR returns."""
    lies: tuple[Lie, ...] = ()
    """What the attack says that it lies about."""


def team_fault(scene: Scene, egos: int, attackers: int) -> tuple[str, str] | None:
    """What there cannot be so many of in a scene, ``egos`` or ``attackers``, and why; None if there can."""
    if not 1 <= egos <= len(scene.egos):
        return "egos", f"must be between 1 and the {len(scene.egos)} that may be one, got {egos}"
    most = len(_others(scene, egos))
    if not 0 <= attackers <= most:
        return "attackers", f"must be between 0 and the {most} vehicles that are no egos, got {attackers}"
    return None


def _others(scene: Scene, egos: int) -> list[str]:
    return [name for name in scene.agents if name not in scene.egos[:egos]]


class Fleet:
    """Vehicles of one scene, some of them attackers.

    An attacker knows the detector and overhears the others' messages of the frame (the white-box setting of the
    literature); it makes a message for each ego, since what harms one need not harm another.

    Parameters
    ----------
    scene : Scene
    detector : Detector
        The vehicles' own copy.
    egos : int
        The first of those that may be.
    attackers : int
        Chosen at random among the vehicles that are not egos.
    attack : Attack or Campaign
    seed : int
    elsewhere : Scene, optional
        Another scene, for attacks that replay what is sensed there.

    Raises
    ------
    ValueError
        If there are fewer vehicles than egos and attackers together need.
    """

    def __init__(
        self,
        scene: Scene,
        detector: Detector,
        egos: int,
        attackers: int,
        attack: Attack | Campaign,
        seed: int,
        elsewhere: Scene | None = None,
    ) -> None:
        if fault := team_fault(scene, egos, attackers):
            raise ValueError(" ".join(fault))
        others = _others(scene, egos)
        self.scene = scene
        self.egos = scene.egos[:egos]
        self.detector = detector
        self._campaign = Campaign.of(attack)
        self._foreign = foreign_views(detector, elsewhere)
        self._pasts: dict[tuple[str, frozenset[str]], Past] = {}
        self._rng = np.random.default_rng([seed, scene.number])
        chosen = self._rng.choice(len(others), attackers, replace=False)
        self.attackers = frozenset(others[i] for i in chosen)

    def teammates(self, ego_id: str) -> list[str]:
        """Everybody else."""
        return [agent for agent in self.scene.agents if agent != ego_id]

    def sense(self, index: int) -> list[EgoFrame]:
        """Frame ``index`` from the side of each ego."""
        frame = self.scene.frame(index)
        messages = encode_all(self.detector, frame)
        return [self._for_ego(ego_id, frame, messages) for ego_id in self.egos if ego_id in messages]

    def _for_ego(self, ego_id: str, frame: Frame, messages: Mapping[str, Message]) -> EgoFrame:
        vehicles, hostile = vehicles_around(frame, ego_id), hostile_in(frame)
        sensed = Sensed(frame.index, ego_id, messages, frame.truth(ego_id), vehicles, hostile)
        past = self._past(ego_id, frame.index)
        met = under_attack(self.detector, sensed, self.attackers, self._campaign, self._rng, past)
        number, points = self.scene.number, frame.views[ego_id].points
        return EgoFrame(number, ego_id, met.attackers, met.benign, met.teammates, met.ego, met.truth, points, met.lies)

    def _past(self, ego_id: str, index: int) -> Past:
        """What those who act in this frame remember of this ego; what they overheard before they acted, too."""
        if not self._campaign.remembers:
            return Past(self.scene.frame_period_s, self._foreign)
        acting = frozenset(self._campaign.schedule(index, sorted(self.attackers)))
        if (ego_id, acting) not in self._pasts:
            overheard = next((past.earlier for (ego, _), past in self._pasts.items() if ego == ego_id), {})
            past = Past(self.scene.frame_period_s, self._foreign, earlier=overheard)
            self._pasts[ego_id, acting] = past
        return self._pasts[ego_id, acting]
