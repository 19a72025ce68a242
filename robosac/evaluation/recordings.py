"""Frames of which every subset of teammates is decoded once, so that defences can be compared without a detector."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from robosac.attacks.situation import Lie
from robosac.boxes import FloatArray
from robosac.calibrated import digest_beside
from robosac.defenses import EGO
from robosac.detectors import Detector, Message
from robosac.detectors.base import check_boxes
from robosac.evaluation.encounters import NOBODY_ACTS, Act, Encounters
from robosac.evaluation.frames import DecodedOnce, EvaluationFrame, Subset
from robosac.files import replacing
from robosac.plugins import package_code
from robosac.scenes import DEFAULT_DATA

FORMAT = 2


def record(frame: EvaluationFrame, unattacked: DecodedOnce | None = None) -> DecodedOnce:
    """Decode all subsets of a frame's teammates, ``2 ** S`` of them.

    Boxes are rounded to float32, as files hold them.

    Parameters
    ----------
    unattacked : DecodedOnce, optional
        The same frame without an attack, recorded, to take the subsets without an attacker from.
    """
    prepared = frame.prepare(frame.ego, frame.teammates)
    boxes: dict[Subset, FloatArray] = {}
    for subset in subsets(frame.team):
        if unattacked is not None and frame.attackers.isdisjoint(subset):
            boxes[subset] = unattacked.detect(subset)
        else:
            boxes[subset] = check_boxes(prepared.detect(sorted(subset))).astype(np.float32).astype(np.float64)
    return decoded(frame, boxes)


def decoded(frame: EvaluationFrame, boxes: dict[Subset, FloatArray]) -> DecodedOnce:
    """A frame of which the boxes of all subsets are known."""
    nothing: dict[str, Message] = {}
    return DecodedOnce(
        frame.detector, frame.ego, nothing, frame.teammates, frame.attackers, frame.truth, boxes, lies=frame.lies
    )


@dataclass
class Recordings(Encounters):
    """Recorded frames of a scene as its first ego meets them under any campaign.

    A frame is determined by the scene, its number, the attack, who acts in it, and the seed, whatever else is recorded:
    a campaign's schedule only chooses among such frames, so campaigns share them.
    """

    folder: Path | None = None
    """Where they are kept and looked for; by default nowhere."""
    data: str = DEFAULT_DATA
    """Name of the scenes' source."""
    code: str = ""
    """Digest of the user's own code that makes them, besides this package; empty where there is none."""
    _recorded: dict[Act, dict[int, DecodedOnce]] = field(default_factory=dict, init=False)

    def met(self, act: Act, indices: Sequence[int]) -> Iterator[DecodedOnce]:
        """As `Encounters.met`, recorded."""
        path = None if self.folder is None else self.folder / self._file(act)
        known = self._recorded.setdefault(act, {})
        if not known and path is not None and path.exists():
            known.update(load(path, self.detector, self._unattacked))
        missing = [index for index in indices if index not in known]
        if missing:
            unattacked = [None] * len(missing) if act == NOBODY_ACTS else self._unattacked(missing)
            for index, frame, honest in zip(missing, super().met(act, missing), unattacked, strict=True):
                known[index] = record(frame, honest)
            if path is not None:
                save(path, known, whole=act == NOBODY_ACTS)
        yield from (known[index] for index in indices)

    def _unattacked(self, indices: Sequence[int]) -> list[DecodedOnce]:
        return list(self.met(NOBODY_ACTS, indices))

    def _file(self, act: Act) -> str:
        info, scene = self.detector.info, self.scene.number
        data = [self.data] if self.data != DEFAULT_DATA else []
        code = [self.code] if self.code else []
        made_by = [package_code(), *code, info.name, info.weights_digest, digest_beside(info)]
        identity = [FORMAT, *data, *made_by, scene, act.attack, *act.acting]
        digest = hashlib.sha256(json.dumps([*identity, self.seed, self.pose_error_m]).encode()).hexdigest()
        return f"{scene}-{re.sub('[^A-Za-z0-9-]', '-', act.attack)}-{len(act.acting)}-{digest[:16]}.npz"


def save(path: Path, frames: Mapping[int, DecodedOnce], whole: bool) -> None:
    """Write frames of one team, by their numbers, to an ``.npz`` file, which takes its place at once.

    What honest messages hold is written only if it is to be the ``whole``: the others are those of the same frame
    without an attack.
    """
    ordered = sorted(frames.items())
    head = [
        {
            "index": i,
            "attackers": sorted(f.attackers),
            "team": list(f.team),
            "poses": {name: message.pose.ravel().tolist() for name, message in f.teammates.items()},
            "lies": [_told(lie) for lie in f.lies],
        }
        for i, f in ordered
    ]
    boxes = [frame.boxes[subset] for _, frame in ordered for subset in subsets(frame.team)]
    tensors: dict[str, Any] = {
        f"{index}/{quote(name, safe='')}/{quote(tensor, safe='')}": values
        for index, frame in ordered
        for name, message in _messages(frame).items()
        if whole or name in frame.attackers
        for tensor, values in message.tensors.items()
    }
    with replacing(path) as beside:
        np.savez_compressed(
            beside,
            head=np.array(json.dumps(head)),
            pose=np.stack([f.ego.pose for _, f in ordered]),
            truth=np.concatenate([f.truth for _, f in ordered]),
            truths=np.array([len(f.truth) for _, f in ordered]),
            boxes=np.concatenate(boxes).astype(np.float32),
            counts=np.array([len(each) for each in boxes]),
            **tensors,
        )


def load(
    path: Path, detector: Detector, unattacked: Callable[[Sequence[int]], list[DecodedOnce]]
) -> dict[int, DecodedOnce]:
    """Frames that `save` wrote, by their numbers; ``detector`` decoded them.

    ``unattacked`` gives the frames of these numbers without an attack.
    """
    with np.load(path) as file:
        head = json.loads(str(file["head"]))
        poses, truths = file["pose"], np.split(file["truth"], np.cumsum(file["truths"])[:-1])
        boxes = iter(np.split(file["boxes"].astype(np.float64), np.cumsum(file["counts"])[:-1]))
        held: dict[tuple[int, str], dict[str, Any]] = {}
        for key in file.files:
            if key.count("/") == 2:
                index, name, tensor = key.split("/")
                held.setdefault((int(index), unquote(name)), {})[unquote(tensor)] = file[key]
    whole = all((entry["index"], EGO) in held for entry in head)
    honest = [None] * len(head) if whole else unattacked([entry["index"] for entry in head])
    frames = {}
    for entry, pose, truth, plain in zip(head, poses, truths, honest, strict=True):
        index, team = entry["index"], entry["team"]
        known = {} if plain is None else {name: message.tensors for name, message in _messages(plain).items()}
        known |= {name: tensors for (number, name), tensors in held.items() if number == index}
        sent = {name: Message(np.array(entry["poses"][name]).reshape(4, 4), known[name]) for name in team}
        lies = tuple(_heard(lie) for lie in entry["lies"])
        attackers = frozenset(entry["attackers"])
        frame = EvaluationFrame(detector, Message(pose, known[EGO]), {}, sent, attackers, truth, lies=lies)
        frames[index] = decoded(frame, {subset: next(boxes) for subset in subsets(team)})
    return frames


def _messages(frame: EvaluationFrame) -> dict[str, Message]:
    return {EGO: frame.ego, **frame.teammates}


def _told(lie: Lie) -> dict[str, Any]:
    truth = None if lie.truth is None else lie.truth.tolist()
    return {"kind": lie.kind, "box": lie.box.tolist(), "number": lie.number, "truth": truth}


def _heard(values: Mapping[str, Any]) -> Lie:
    truth = None if values["truth"] is None else np.array(values["truth"])
    return Lie(values["kind"], np.array(values["box"]), values["number"], truth)


def subsets(team: Sequence[str]) -> list[Subset]:
    """All subsets of a team, the smaller ones first."""
    return [frozenset(c) for size in range(len(team) + 1) for c in combinations(team, size)]
