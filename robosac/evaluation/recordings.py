"""Frames of which every subset of teammates is decoded once, so that defences can be compared without a detector."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from robosac.attacks import Attack
from robosac.boxes import FloatArray
from robosac.detectors import Detector, DetectorInfo, Message, PreparedFrame
from robosac.evaluation.frames import EvaluationFrame, encode_all, misplaced, under_attack
from robosac.scenes import IntersectionScene

Subset = frozenset[str]
_POSES = 53


@dataclass(frozen=True)
class RecordedFrame:
    """One test frame with the boxes of all subsets, posing as the detector that decoded them.

    Attributes
    ----------
    info : DetectorInfo
        Of the detector that decoded it.
    pose : (4, 4) ndarray
        world_from_sensor of the ego.
    team : tuple of str
        Sorted.
    attackers : frozenset of str
    truth : (G, 5) ndarray
        Ego frame.
    boxes : mapping of subset to (n, 6) ndarray
        As received; the empty subset is the ego alone.
    """

    info: DetectorInfo
    pose: FloatArray
    team: tuple[str, ...]
    attackers: Subset
    truth: FloatArray
    boxes: Mapping[Subset, FloatArray]

    @property
    def benign(self) -> Subset:
        """Teammates that do not attack."""
        return frozenset(self.team) - self.attackers

    @property
    def ego(self) -> Message:
        """The ego's message, without its tensors."""
        return Message(self.pose, {})

    @property
    def teammates(self) -> dict[str, Message]:
        """The teammates' messages, without pose and tensors."""
        return dict.fromkeys(self.team, self.ego)

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:  # noqa: ARG002
        """The frame itself."""
        return self

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset, as they were decoded."""
        return self.boxes[frozenset(teammates)]


def record(detector: Detector, frame: EvaluationFrame, unattacked: RecordedFrame | None = None) -> RecordedFrame:
    """Decode all subsets of a frame's teammates, ``2 ** S`` of them.

    Parameters
    ----------
    detector : Detector
    frame : EvaluationFrame
    unattacked : RecordedFrame, optional
        The same frame without an attack, to take the subsets without an attacker from.
    """
    prepared = detector.prepare(frame.ego, frame.received)
    team = tuple(sorted(frame.received))
    boxes: dict[Subset, FloatArray] = {}
    for size in range(len(team) + 1):
        for subset in combinations(team, size):
            same = unattacked is not None and frame.attackers.isdisjoint(subset)
            boxes[frozenset(subset)] = unattacked.detect(subset) if unattacked and same else prepared.detect(subset)
    return RecordedFrame(detector.info, frame.ego.pose, team, frame.attackers, frame.truth, boxes)


def record_sequence(
    detector: Detector,
    seed: int,
    frames: int,
    attack: Attack,
    attackers: Collection[str],
    rng: np.random.Generator,
    *,
    unattacked: Sequence[RecordedFrame] | None = None,
    stride: int = 1,
    ego_id: str = "car-1",
    pose_error_m: float = 0.0,
) -> Iterator[RecordedFrame]:
    """A scene's frames as one ego meets them, the attackers staying the same.

    Parameters
    ----------
    detector : Detector
    seed : int
        The scene.
    frames, stride : int
        How many, and every how many frames of 0.2 s.
    attack : Attack
    attackers : collection of str
        None of them: an honest team.
    rng : numpy.random.Generator
        The attack's.
    unattacked : sequence of RecordedFrame, optional
        The same frames of the honest team, recorded before.
    ego_id : str
    pose_error_m : float
        Standard deviation of the error of each teammate's position, metres; the same errors whatever the attack.
    """
    poses = np.random.default_rng([seed, _POSES])
    for index, frame in enumerate(IntersectionScene(seed).frames(frames, stride=stride)):
        encoded = encode_all(detector, frame)
        messages = {n: m if n == ego_id else misplaced(m, pose_error_m, poses) for n, m in encoded.items()}
        met = under_attack(detector, messages, frame.truth(ego_id), ego_id, attackers, attack, rng)
        yield record(detector, met, None if unattacked is None else unattacked[index])


def save(path: Path, frames: Sequence[RecordedFrame]) -> None:
    """Write frames of one team to an ``.npz`` file; boxes are rounded to float32."""
    head = [{"attackers": sorted(f.attackers), "team": list(f.team)} for f in frames]
    subsets = [(f, boxes) for f in frames for _, boxes in _in_order(f)]
    np.savez_compressed(
        path,
        head=np.array(json.dumps(head)),
        pose=np.stack([f.pose for f in frames]),
        truth=np.concatenate([f.truth for f in frames]),
        truths=np.array([len(f.truth) for f in frames]),
        boxes=np.concatenate([boxes for _, boxes in subsets]).astype(np.float32),
        counts=np.array([len(boxes) for _, boxes in subsets]),
    )


def load(path: Path, info: DetectorInfo) -> list[RecordedFrame]:
    """Frames that `save` wrote; ``info`` is the detector's that decoded them."""
    with np.load(path) as file:
        head = json.loads(str(file["head"]))
        poses, truths = file["pose"], np.split(file["truth"], np.cumsum(file["truths"])[:-1])
        boxes = iter(np.split(file["boxes"].astype(np.float64), np.cumsum(file["counts"])[:-1]))
    frames = []
    for entry, pose, truth in zip(head, poses, truths, strict=True):
        team = tuple(entry["team"])
        decoded = {subset: next(boxes) for subset in _subsets(team)}
        frames.append(RecordedFrame(info, pose, team, frozenset(entry["attackers"]), truth, decoded))
    return frames


def _subsets(team: tuple[str, ...]) -> list[Subset]:
    return [frozenset(c) for size in range(len(team) + 1) for c in combinations(team, size)]


def _in_order(frame: RecordedFrame) -> list[tuple[Subset, FloatArray]]:
    return [(subset, frame.boxes[subset]) for subset in _subsets(frame.team)]
