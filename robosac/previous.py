"""The previous answer as the reference of the next frame (temporal consistency)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from robosac.boxes import FloatArray, from_units, from_world, in_units, to_world

FOLLOWED_M = 3.0
"""A vehicle is followed from one frame to the next if it moved less than this: 15 m/s at 5 Hz."""


@dataclass(frozen=True)
class PreviousAnswer:
    """A collaborative answer, kept as the reference of the next frame."""

    frame: int
    boxes: FloatArray
    """(n, 6) float64: x, y, length, width, yaw, score; world frame."""
    motion: FloatArray
    """(n, 2) float64: how far each box moved since the frame before, metres; 0 where that is not known."""

    @classmethod
    def of(
        cls, frame: int, pose: FloatArray, boxes: FloatArray, before: PreviousAnswer | None = None
    ) -> PreviousAnswer:
        """Keep the answer to a frame; motion is known if the answer before it is of the frame before.

        Boxes of the two answers are the same vehicle where they match one to one with the least total distance, up to
        `FOLLOWED_M` each.

        Parameters
        ----------
        frame : int
        pose : (4, 4) ndarray
            world_from_sensor of the ego.
        boxes : (n, 6) ndarray
            In the ego's frame. What is kept of them is rounded to `robosac.boxes.BOX_UNITS`, as an audit log has them.
        before : PreviousAnswer, optional
        """
        placed = to_world(from_units(in_units(boxes)), pose)
        motion = np.zeros((len(placed), 2))
        if before is not None and before.frame == frame - 1:
            distance = cdist(placed[:, :2], before.boxes[:, :2])
            now, then = linear_sum_assignment(np.minimum(distance, FOLLOWED_M))
            same = distance[now, then] < FOLLOWED_M
            motion[now[same]] = placed[now[same], :2] - before.boxes[then[same], :2]
        return cls(frame, placed, motion)

    def as_json(self) -> dict[str, Any]:
        """JSON values, which `from_json` reads back."""
        return {"frame": self.frame, "boxes": self.boxes.tolist(), "motion": self.motion.tolist()}

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> PreviousAnswer:
        """What `as_json` gave; `ValueError` for anything else."""
        try:
            boxes = np.array(fields["boxes"], dtype=np.float64).reshape(-1, 6)
            motion = np.array(fields["motion"], dtype=np.float64).reshape(len(boxes), 2)
            return cls(int(fields["frame"]), boxes, motion)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"no previous answer: {type(error).__name__}: {error}") from error

    def expected_at(self, pose: FloatArray) -> FloatArray:
        """The boxes (n, 6) one frame later, in the frame of the ego at ``pose``: each moved as it moved before."""
        moved = self.boxes.copy()
        moved[:, :2] += self.motion
        return from_world(moved, pose)
