"""How much worse than where the likelihoods were calibrated honest fusions agree in the world at hand.

Where a detector is unsure, as among objects that it was not trained for, honest messages shift, lose and add more boxes
than they did where it was calibrated. What that world is like nobody knows beforehand. So the calibrated world stands
beside others in which everything that changes does so by a factor more, and the session learns which fits. Only what
honest messages show is stretched so; what attacks show is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import FloatArray

STRETCHES = (1.0, 1.4, 2.0, 2.8)
"""How many times more changes in each of the worlds."""
PRIOR = (0.85, 0.1, 0.035, 0.015)
"""How likely each is beforehand."""
FORGETTING = 0.02
"""Each frame the weights of the worlds go back towards the prior by this share."""


@dataclass
class Strangeness:
    """Mutable while a frame is judged."""

    weights: FloatArray = field(default_factory=lambda: np.array(PRIOR))
    """(len(STRETCHES),): how likely each world is; they sum to 1."""

    def step(self) -> None:
        """Another frame."""
        self.weights = (1 - FORGETTING) * self.weights + FORGETTING * np.array(PRIOR)

    def learn(self, likelihood: FloatArray, cells: FloatArray, weight: float) -> None:
        """Take in a finding: its likelihood (worlds, cells) in each world, the probability of what is true (cells,),
        and what it counts.
        """
        self.weights = self.weights * np.maximum(likelihood @ cells, 1e-12) ** weight
        self.weights /= self.weights.sum()

    def to_state(self) -> list[float]:
        """What `from_state` reads."""
        return [round(float(w), 9) for w in self.weights]

    @classmethod
    def from_state(cls, state: Sequence[float]) -> Strangeness:
        """What `to_state` wrote."""
        weights = np.array(state, dtype=np.float64)
        return cls(weights / weights.sum())


def stretched(edges: Sequence[float], stretch: float) -> FloatArray:
    """What each bin of a histogram gives to each when all values grow by a factor: (n + 1, n + 1).

    Parameters
    ----------
    edges : (n,) sequence of float
        Between bins, ascending from above 0. Values are at least 0; those of the last bin lie within twice its edge.
    stretch : float
        The factor, at least 1.
    """
    low, high = np.array([0.0, *edges]), np.array([*edges, 2.0 * edges[-1]])
    end = np.append(edges, np.inf)
    shared = np.minimum(end, stretch * high[:, None]) - np.maximum(low, stretch * low[:, None])
    share: FloatArray = np.maximum(shared, 0.0) / (stretch * (high - low))[:, None]
    return share
