"""A decided frame as it is kept for those who watch, and as JSON."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.answers import FrameAnswer, Verdict
from robosac.boxes import FloatArray, from_world, pairwise_iou
from robosac.faults import printable
from robosac.fusion import FusionResult
from service.viewing import words

MOST_FUSIONS = 8
"""Rejected fusions of a frame whose boxes are kept."""
SAME_BOX_IOU = 0.3
"""From which on a box of a rejected fusion is one that was answered, too."""
DECIMALS = 4


@dataclass
class Seen:
    """A frame to be watched: what was answered, and what its tests showed. No tensors.

    Boxes (n, 6) are in the ego's frame, poses are world_from_sensor.
    """

    answer: FrameAnswer
    own: FloatArray | None
    """All that the ego saw alone; None where that was not decoded."""
    fusions: Mapping[int, FloatArray]
    """By its number among the tests: what a rejected fusion would have shown."""
    ego_pose: FloatArray
    poses: Mapping[str, FloatArray]
    """Of the teammates whose messages came, as they claim."""
    time: float = field(default_factory=time.time)
    """When it was answered, Unix seconds."""
    text: str | None = None
    """Its JSON, once somebody has asked for it."""

    @classmethod
    def of(
        cls, answer: FrameAnswer, result: FusionResult, ego_pose: FloatArray, poses: Mapping[str, FloatArray]
    ) -> Seen:
        """What is kept of a frame; nothing is computed or copied."""
        own = next((o.alone for o in result.hypotheses if o.alone is not None), None)
        if own is None and not answer.accepted:
            own = result.boxes
        rejected = {
            number: outcome.boxes
            for number, outcome in enumerate(result.hypotheses)
            if outcome.verdict is Verdict.DISSENSUS and outcome.boxes is not None
        }
        kept = dict(list(rejected.items())[:MOST_FUSIONS])
        return cls(answer, own, kept, ego_pose, poses)

    def as_json(self, least_score: float) -> str:
        """The frame as JSON, made once; from a score on boxes count as certain."""
        if self.text is None:
            self.text = json.dumps(self._shown(least_score), separators=(",", ":"), allow_nan=False)
        return self.text

    def _shown(self, least_score: float) -> dict[str, Any]:
        answer = self.answer
        told = answer.model_dump(
            mode="json",
            include={"frame", "source", "accepted", "hypotheses", "sampling_steps", "attacker_ratio", "suspicion",
                     "support", "contradicted", "alike", "deadline_met", "degraded_by", "timings_ms"},
        )  # fmt: skip
        for out in told["contradicted"] or ():
            out["box"] = [round(value, DECIMALS) for value in out["box"]]
        return {
            **told,
            "time": round(self.time, 3),
            "seq": None if answer.receipt is None else answer.receipt.seq,
            "boxes": _rounded(answer.boxes),
            "own": None if self.own is None else _rounded(self.own[self.own[:, 5] >= least_score]),
            "averted": self._averted(least_score),
            "ego_pose": _in_plane(self.ego_pose),
            "teammates": _placed(self.poses, self.ego_pose),
            "named": list(answer.named),
            "rejected": [
                {
                    "vehicle_id": printable(name),
                    "reason": entry.reason.value,
                    "distrust": entry.distrust,
                    "why": words.of_rejection(entry),
                    "evidence": words.of_evidence(entry),
                }
                for name, entry in answer.rejected.items()
            ],
            "sentence": words.of_frame(answer),
        }

    def _averted(self, least_score: float) -> list[dict[str, Any]]:
        """Boxes that only a rejected fusion shows: those that nobody was answered."""
        averted = []
        for number, boxes in self.fusions.items():
            certain = boxes[boxes[:, 5] >= least_score]
            if len(certain) and len(self.answer.boxes):
                overlap = pairwise_iou(certain, self.answer.boxes).max(axis=1)
                certain = certain[overlap < SAME_BOX_IOU]
            averted.append({"hypothesis": number, "boxes": _rounded(certain)})
        return averted


def _rounded(boxes: FloatArray) -> Any:
    return np.round(np.nan_to_num(boxes), DECIMALS).tolist()


def _in_plane(pose: FloatArray) -> list[float]:
    """x, y, yaw."""
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    return [round(float(value), DECIMALS) for value in (pose[0, 3], pose[1, 3], yaw)]


def _placed(poses: Mapping[str, FloatArray], ego_pose: FloatArray) -> list[dict[str, Any]]:
    """Where teammates are, as they claim, in the ego's frame."""
    if not poses:
        return []
    there = np.array([[x, y, 0.0, 0.0, yaw] for x, y, yaw in map(_in_plane, poses.values())])
    here: Sequence[Sequence[float]] = np.round(from_world(there, ego_pose), DECIMALS).tolist()
    return [
        {"vehicle_id": printable(name), "x": x, "y": y, "yaw": yaw, "range_m": round(float(np.hypot(x, y)), 2)}
        for name, (x, y, _, _, yaw) in zip(poses, here, strict=True)
    ]
