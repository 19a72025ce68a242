"""Test frames as their egos meet them: messages, some of them an attacker's, and true boxes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robosac.attacks import Attack, Campaign
from robosac.boxes import FloatArray, pose_matrix
from robosac.detectors import Detector, Message, PreparedFrame, V2XSimDetector
from robosac.detectors.base import for_role
from robosac.scenes import FRAMES_PER_SECOND, IntersectionScene, SceneFrame, v2xsim

YAW_PER_METRE = np.deg2rad(2.0)
"""Standard deviation of the heading's error for each metre of the position's."""


@dataclass(frozen=True)
class EvaluationFrame:
    """One test frame as its ego meets it.

    Attributes
    ----------
    ego : Message
    benign : dict of teammate to Message
    received : dict of teammate to Message
        With the attackers' messages in place of their benign ones.
    attackers : frozenset of str
        Those whose message of this frame is not what an honest one would send.
    truth : (G, 5) ndarray
        Ego frame.
    """

    ego: Message
    benign: dict[str, Message]
    received: dict[str, Message]
    attackers: frozenset[str]
    truth: FloatArray


def encode_all(detector: Detector, frame: SceneFrame) -> dict[str, Message]:
    """Every agent's message, with all that it would send as an ego."""
    return {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}


def misplaced(message: Message, pose_error_m: float, rng: np.random.Generator) -> Message:
    """A message whose sender is wrong about where it is: normal errors in x, y and heading."""
    if not pose_error_m:
        return message
    pose = message.pose
    dx, dy = rng.normal(0.0, pose_error_m, 2)
    turn = pose_matrix(0.0, 0.0, 0.0, rng.normal(0.0, pose_error_m * YAW_PER_METRE))
    wrong = pose.copy()
    wrong[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    wrong[:2, 3] += dx, dy
    return Message(wrong, message.tensors)


def under_attack(
    detector: Detector,
    messages: Mapping[str, Message],
    truth: FloatArray,
    ego_id: str,
    attackers: Collection[str],
    attack: Attack | Campaign,
    rng: np.random.Generator,
    index: int = 0,
) -> EvaluationFrame:
    """One instant as one ego meets it, with some teammates under the adversary's control.

    Parameters
    ----------
    detector : Detector
    messages : mapping of agent to Message
        Everybody's, the ego's among them, each with all that it would send as an ego.
    truth : (G, 5) ndarray
        For that ego, in its frame.
    ego_id : str
    attackers : collection of str
        Optimised jointly.
    attack : Attack or Campaign
    rng : numpy.random.Generator
        The attack's.
    index : int
        The frame's number in its sequence, which a campaign's schedule goes by.
    """
    ego = messages[ego_id]
    benign = {name: for_role(m, detector.info, "teammate") for name, m in messages.items() if name != ego_id}
    sent = Campaign.of(attack).messages(detector, ego, benign, attackers, index, rng)
    return EvaluationFrame(ego, benign, {**benign, **sent}, frozenset(sent), truth)


def evaluation_frames(
    detector: Detector,
    seeds: Sequence[int],
    frames_per_scene: int,
    attack: Attack | Campaign,
    attackers: int,
    rng: np.random.Generator,
) -> Iterator[EvaluationFrame]:
    """Frames 1 s apart of every scene, the cars taking turns as ego, random teammates attacking."""
    turn = 0
    for seed in seeds:
        scene = IntersectionScene(seed)
        for frame in scene.frames(frames_per_scene, stride=FRAMES_PER_SECOND):
            ego_id = f"car-{turn % scene.car_agents + 1}"
            turn += 1
            chosen = _draw(set(scene.agents) - {ego_id}, attackers, rng)
            messages, truth = encode_all(detector, frame), frame.truth(ego_id)
            yield under_attack(detector, messages, truth, ego_id, chosen, attack, rng, frame.index)


def v2xsim_frames(
    detector: V2XSimDetector,
    root: Path,
    scenes: Sequence[int],
    frames_per_scene: int,
    attack: Attack | Campaign,
    attackers: int,
    collaborators: int,
    rng: np.random.Generator,
) -> Iterator[EvaluationFrame | None]:
    """The same of V2X-Sim samples: every fifth frame of each scene, its vehicles taking turns as ego.

    Yields
    ------
    EvaluationFrame or None
        None for a frame in which there is no vehicle, or fewer than ``attackers + collaborators`` teammates.

    Raises
    ------
    robosac.scenes.v2xsim.SampleError
        If a file is not a sample.
    """
    turn = 0
    for scene in scenes:
        for frame in v2xsim.frames(root, scene, frames_per_scene, stride=FRAMES_PER_SECOND):
            vehicles = sorted(set(frame.samples) - {v2xsim.ROADSIDE_UNIT})
            if not vehicles or len(frame.samples) - 1 < attackers + collaborators:
                yield None
                continue
            ego_id = vehicles[turn % len(vehicles)]
            turn += 1
            messages = {
                name: detector.encode_grid(sample.grid, frame.pose(name)) for name, sample in frame.samples.items()
            }
            chosen = _draw(set(messages) - {ego_id}, attackers, rng)
            yield under_attack(detector, messages, frame.truth(ego_id), ego_id, chosen, attack, rng, frame.index)


def _draw(team: Collection[str], attackers: int, rng: np.random.Generator) -> list[str]:
    return [str(name) for name in rng.choice(sorted(team), attackers, replace=False)]


class DecodedOnce:
    """A prepared frame that decodes each subset once, posing as the detector that prepared it."""

    def __init__(self, detector: Detector, ego: Message, teammates: Mapping[str, Message]) -> None:
        self.info = detector.info
        self._prepared = detector.prepare(ego, teammates)
        self._boxes: dict[frozenset[str], FloatArray] = {}

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:  # noqa: ARG002 (always the same)
        """The frame itself."""
        return self

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset, decoded at most once."""
        key = frozenset(teammates)
        if key not in self._boxes:
            self._boxes[key] = self._prepared.detect(teammates)
        return self._boxes[key]
