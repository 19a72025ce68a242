"""Frames of which every subset of teammates is decoded once, so that defences can be compared without a detector."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from robosac.attacks import HONEST
from robosac.boxes import FloatArray
from robosac.detectors import Detector, DetectorInfo, Message, PreparedFrame
from robosac.evaluation.encounters import NOBODY_ACTS, Act, Encounters, acts
from robosac.evaluation.frames import EvaluationFrame
from robosac.scenes import DEFAULT_DATA, Scene

Subset = frozenset[str]
FORMAT = 1


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


def record(frame: EvaluationFrame, unattacked: RecordedFrame | None = None) -> RecordedFrame:
    """Decode all subsets of a frame's teammates, ``2 ** S`` of them; boxes are rounded to float32, as files hold them.

    Parameters
    ----------
    frame : EvaluationFrame
    unattacked : RecordedFrame, optional
        The same frame without an attack, to take the subsets without an attacker from.
    """
    prepared = frame.prepare(frame.ego, frame.teammates)
    boxes: dict[Subset, FloatArray] = {}
    for subset in subsets(frame.team):
        if unattacked is not None and frame.attackers.isdisjoint(subset):
            boxes[subset] = unattacked.detect(subset)
        else:
            boxes[subset] = prepared.detect(sorted(subset)).astype(np.float32).astype(np.float64)
    return RecordedFrame(frame.info, frame.ego.pose, frame.team, frame.attackers, frame.truth, boxes)


class Recordings:
    """Recorded frames of sequences, as one ego meets them under any campaign.

    A frame is determined by the scene, its number, the attack, who acts in it, and the seed, whatever else is recorded:
    a campaign's schedule only chooses among such frames, so campaigns share them.

    Parameters
    ----------
    detector : Detector
    folder : Path, optional
        Where they are kept and looked for; by default nowhere.
    seed, pose_error_m : int, float
        As for `Encounters`.
    data : str
        Name of the scenes' source.
    """

    def __init__(
        self,
        detector: Detector,
        folder: Path | None = None,
        *,
        seed: int = 0,
        pose_error_m: float = 0.0,
        data: str = DEFAULT_DATA,
    ) -> None:
        self._detector = detector
        self._folder = folder
        self._seed = seed
        self._pose_error_m = pose_error_m
        self._data = data
        self._encounters = Encounters(detector, seed=seed, pose_error_m=pose_error_m)
        self._scene: Scene | None = None
        self._recorded: dict[Act, dict[int, RecordedFrame]] = {}

    def sequence(
        self,
        scene: Scene,
        frames: int,
        campaign: str = HONEST,
        attackers: Collection[str] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> list[RecordedFrame]:
        """As `Encounters.sequence`, recorded. What was recorded of a scene is held until the next is asked for."""
        if scene != self._scene:
            self._scene, self._recorded = scene, {}
        chosen = acts(campaign, attackers, frames)
        needed: dict[Act, list[int]] = {NOBODY_ACTS: list(range(frames))}
        for index, act in enumerate(chosen):
            if act != NOBODY_ACTS:
                needed.setdefault(act, []).append(index)
        for act, indices in needed.items():
            self._complete(scene, frames, act, indices)
        sequence = []
        for index, act in enumerate(chosen):
            sequence.append(self._recorded[act][index])
            tick()
        return sequence

    def _complete(self, scene: Scene, frames: int, act: Act, indices: Sequence[int]) -> None:
        """Read or record the frames of these numbers."""
        path = None if self._folder is None else self._folder / self._file(scene.number, act)
        known = self._recorded.setdefault(act, {})
        if not known and path is not None and path.exists():
            known.update(load(path, self._detector.info))
        missing = [index for index in indices if index not in known]
        if not missing:
            return
        for index, met in zip(missing, self._encounters.met(scene, frames, act, missing), strict=True):
            honest = self._recorded[NOBODY_ACTS][index] if act.acting else None
            known[index] = record(met, honest)
        if path is not None:
            save(path, known)

    def _file(self, scene: int, act: Act) -> str:
        info = self._detector.info
        data = [self._data] if self._data != DEFAULT_DATA else []
        identity = [FORMAT, *data, info.name, info.weights_digest, scene, act.attack, *act.acting]
        digest = hashlib.sha256(json.dumps([*identity, self._seed, self._pose_error_m]).encode()).hexdigest()
        return f"{scene}-{re.sub('[^A-Za-z0-9-]', '-', act.attack)}-{len(act.acting)}-{digest[:16]}.npz"


def save(path: Path, frames: Mapping[int, RecordedFrame]) -> None:
    """Write frames of one team, by their numbers, to an ``.npz`` file, which takes its place at once."""
    ordered = sorted(frames.items())
    head = [{"index": i, "attackers": sorted(f.attackers), "team": list(f.team)} for i, f in ordered]
    boxes = [frame.boxes[subset] for _, frame in ordered for subset in subsets(frame.team)]
    partial = path.with_name(f"{path.stem}.{os.getpid()}.npz")
    np.savez_compressed(
        partial,
        head=np.array(json.dumps(head)),
        pose=np.stack([f.pose for _, f in ordered]),
        truth=np.concatenate([f.truth for _, f in ordered]),
        truths=np.array([len(f.truth) for _, f in ordered]),
        boxes=np.concatenate(boxes).astype(np.float32),
        counts=np.array([len(each) for each in boxes]),
    )
    partial.replace(path)


def load(path: Path, info: DetectorInfo) -> dict[int, RecordedFrame]:
    """Frames that `save` wrote; ``info`` is the detector's that decoded them."""
    with np.load(path) as file:
        head = json.loads(str(file["head"]))
        poses, truths = file["pose"], np.split(file["truth"], np.cumsum(file["truths"])[:-1])
        boxes = iter(np.split(file["boxes"].astype(np.float64), np.cumsum(file["counts"])[:-1]))
    frames = {}
    for entry, pose, truth in zip(head, poses, truths, strict=True):
        team = tuple(entry["team"])
        decoded = {subset: next(boxes) for subset in subsets(team)}
        frames[entry["index"]] = RecordedFrame(info, pose, team, frozenset(entry["attackers"]), truth, decoded)
    return frames


def subsets(team: Sequence[str]) -> list[Subset]:
    """All subsets of a team, the smaller ones first."""
    return [frozenset(c) for size in range(len(team) + 1) for c in combinations(team, size)]
