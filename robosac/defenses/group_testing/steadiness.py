"""How unsteady a teammate's own fusions are beside the ego's own perception: what it takes to name it.

Suspicion says who is left out. It rests on likelihoods that were calibrated in some world, and in another one honest
teammates may look odd. To name somebody takes a second statistic, made of nothing but the ego's and the suspect's own
messages, and measured against the ego's own flicker. No third message enters it, so nobody can frame anybody by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

NAMES = 12.0
"""An honest teammate comes so far with a probability of about ``exp(-12)`` a comparison, were it exact."""
LEAST_RATE = 0.1
"""Changes a box, from frame to frame, below which the ego's own rate is not believed."""
STEADY_RATE = 0.2
"""Up to this rate of the ego's own, fusions are as steady as where they were calibrated."""
FIRST_TRUST = 0.5
"""What evidence against somebody is worth as long as the ego's own rate is not known."""
EXCESS = 0.15
"""By how much an attacker's rate of changes is larger than the ego's, at least."""
PRIOR_CHANGES, PRIOR_BOXES = 2.1, 30.0
"""What the ego's rate rests on before anything was seen."""
NOW_CHANGES, NOW_BOXES = 1.0, 10.0
"""The same of the rate in this frame alone: an ego that jumps shakes all fusions at once."""
FEWEST_BOXES = 12
LARGEST_STEP = 15.0


@dataclass
class Steadiness:
    """Mutable while a frame is judged."""

    changes: float = 0.0
    boxes: float = 0.0
    """Of the ego alone, summed over the frames of the session: boxes that came or went since the frame before, and
    boxes.
    """
    levels: dict[str, float] = field(default_factory=dict)
    """By teammate: S, see `learn`; those at 0 are left out."""
    _compared: bool = field(default=False, init=False)
    _unknown: bool = field(default=False, init=False)
    _rate: float = field(default=LEAST_RATE, init=False)

    @property
    def rate(self) -> float:
        """Changes a box that the ego's own flicker lets expect in this frame, at least `LEAST_RATE`."""
        return self._rate

    @property
    def calm(self) -> float:
        """In (0, 1]: little where even the ego alone is much less steady than where the likelihoods were calibrated."""
        return min(1.0, (STEADY_RATE / self._rate) ** 4)

    @property
    def trust(self) -> float:
        """What evidence from whole fusions is worth in this frame that speaks against somebody, in (0, 1]: as much as
        it is `calm`, and half before that is known.
        """
        return FIRST_TRUST if self._unknown else self.calm

    def begin(self, alone: tuple[int, int] | None) -> None:
        """Take in what the ego alone shows in a frame.

        ``b = max(.1, (2.1 + C) / (30 + N), (c + 1) / (n + 10))`` with the ego's own changes c of n boxes in this frame,
        and C of N so far.

        Parameters
        ----------
        alone : (int, int) or None
            Boxes n and changes c; None if the ego cannot be compared with the frame before.
        """
        self._compared = alone is not None
        self._unknown = alone is None and not self.boxes
        boxes, changes = alone or (0, 0)
        self.changes += changes
        self.boxes += boxes
        so_far = (PRIOR_CHANGES + self.changes) / (PRIOR_BOXES + self.boxes)
        now = (changes + NOW_CHANGES) / (boxes + NOW_BOXES) if alone else 0.0
        self._rate = max(LEAST_RATE, so_far, now)

    def unexpected(self, boxes: int, changes: int) -> int:
        """Changes of a fusion with so many boxes beyond those that the ego's flicker explains."""
        return max(0, round(changes - (self._rate - LEAST_RATE) * boxes))

    def learn(self, singles: Mapping[str, tuple[int, int]]) -> None:
        """Take in the fusions of single teammates.

        ``z = min(15, c_i ln((b + x) / b) - x max(n_i, 12))`` with ``x = max(.15, b)`` is the logarithm of the
        likelihood ratio of Poisson rates b + x and b, and ``S_i = max(0, S_i + z)`` (a cumulative sum: Page, Biometrika
        41, 1954).

        Parameters
        ----------
        singles : mapping of teammate to (int, int)
            Boxes n_i and changes c_i of the fusion of the ego and this teammate, where it was decoded in the frame
            before, too.
        """
        if not self._compared:
            return
        excess = max(EXCESS, self._rate)
        for name, (shown, changed) in singles.items():
            step = changed * math.log((self._rate + excess) / self._rate) - excess * max(shown, FEWEST_BOXES)
            level = max(0.0, self.levels.pop(name, 0.0) + min(LARGEST_STEP, step))
            if level:
                self.levels[name] = round(level, 4)

    def names(self, teammate: str) -> bool:
        """Whether a teammate is too unsteady for chance."""
        return self.levels.get(teammate, 0.0) >= NAMES

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        return {"changes": self.changes, "boxes": self.boxes, "levels": self.levels}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Steadiness:
        """What `to_state` wrote."""
        levels = {str(name): float(level) for name, level in state["levels"].items()}
        return cls(float(state["changes"]), float(state["boxes"]), levels)
