"""Whether the poses that vehicles claim are possible."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from robosac.boxes import FloatArray

SLACK_M = 2.0
"""Jump of a position fix that is nobody's fault."""


class Motion:
    """Where the vehicles of a session were last, and where they can be by now.

    Parameters
    ----------
    max_speed_mps : float
    frame_period_s : float
        Time between two frames with consecutive numbers.
    max_range_m : float
        Largest distance between ego and teammate.
    """

    def __init__(self, max_speed_mps: float, frame_period_s: float, max_range_m: float) -> None:
        self._reach_m = max_speed_mps * frame_period_s
        self._max_range_m = max_range_m
        self._last: dict[str, tuple[int, FloatArray]] = {}

    def implausible(self, vehicle: str, frame: int, pose: FloatArray, ego_pose: FloatArray | None = None) -> str | None:
        """Why a pose (4, 4) cannot be, or None.

        A vehicle of which nothing is known may be anywhere; a teammate only within range of the ego.
        """
        place = pose[:3, 3]
        if ego_pose is not None:
            distance = float(np.linalg.norm(place - ego_pose[:3, 3]))
            if distance > self._max_range_m:
                return f"{distance:.0f} m from the ego; at most {self._max_range_m:g} m are allowed"
        if vehicle not in self._last:
            return None
        then, before = self._last[vehicle]
        moved, reach = float(np.linalg.norm(place - before)), self._reach_m * max(frame - then, 1) + SLACK_M
        if moved > reach:
            return f"{moved:.0f} m from where it was in frame {then}; {reach:.0f} m are possible"
        return None

    def moved(self, vehicle: str, frame: int, pose: FloatArray) -> None:
        """Remember a pose that was believed."""
        self._last[vehicle] = (frame, pose[:3, 3].copy())

    def forget_all_but(self, vehicles: Collection[str]) -> None:
        """Let go of those who have left."""
        self._last = {name: last for name, last in self._last.items() if name in vehicles}
