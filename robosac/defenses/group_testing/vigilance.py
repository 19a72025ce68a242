"""When everybody is to be looked at again: once boxes stand farther from where witnesses see the vehicles than before.

Whoever has proved harmless is left alone for long. Somebody who begins to move all vehicles a little only then shows in
the answer itself: all its boxes are off at once. That takes no pass to see, and says nothing about who it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robosac.defenses.group_testing.objects import PLACED_SCORE, Shown
from robosac.defenses.group_testing.straying import FEW, FEWEST_WITNESSES, distances, median

LEARNING = 5
"""Frames from which on it is known how far boxes are usually off."""
USUAL_FRAMES = 25
"""What is usual is a running mean over about so many frames."""
MOST = 1.5
"""What a frame counts, at most: one alone does not tell."""
DRIFT = 0.5
"""What is taken off in each frame."""
ALARM = 2.0
"""The level from which on everybody is looked at again."""


@dataclass
class Vigilance:
    """Mutable while a frame is judged."""

    usual: float = 0.0
    """How far boxes are off, as `distances` has it: a running mean."""
    frames: int = 0
    """That it rests on."""
    level: float = 0.0
    """A cumulative sum (Page, Continuous Inspection Schemes, Biometrika 41, 1954) of how much farther they are."""

    def learn(self, answer: Shown) -> bool:
        """Take in the fusion of an answer; whether everybody is to be looked at again.

        With a the mean over its n boxes of `distances`, from the median of where witnesses see the vehicle, and u what
        is usual: ``level = max(0, level + min(1.5, (a - u) sqrt(n + 4) - .5))``. At 2 there is an alarm, and all is
        learned anew. Boxes of score >= .4 count that two witnesses support.
        """
        seen, placed = answer.seen.centre, answer.boxes[:, 5] >= PLACED_SCORE
        counts = placed & ((~np.isnan(seen[..., 0])).sum(axis=0) >= FEWEST_WITNESSES)
        boxes = answer.boxes[counts]
        if not len(boxes):
            return False
        off = float(distances(boxes, median(seen[:, counts]), boxes[:, 4]).mean())
        if self.frames >= LEARNING:
            rise = (off - self.usual) * float(np.sqrt(len(boxes) + FEW)) - DRIFT
            self.level = round(max(0.0, self.level + min(MOST, rise)), 4)
            if self.level >= ALARM:
                self.usual, self.frames, self.level = 0.0, 0, 0.0
                return True
        self.frames = min(self.frames + 1, USUAL_FRAMES)
        self.usual = round(self.usual + (off - self.usual) / self.frames, 4)
        return False

    def to_state(self) -> list[float]:
        """JSON values that `from_state` reads."""
        return [self.usual, self.frames, self.level]

    @classmethod
    def from_state(cls, state: Sequence[float]) -> Vigilance:
        """What `to_state` wrote; of nothing, as in the states of older versions, nothing is learned yet."""
        if not state:
            return cls()
        usual, frames, level = state
        return cls(float(usual), int(frames), float(level))
