"""How much worse than where the likelihoods were calibrated honest fusions agree in the world at hand.

Where a detector is unsure, as among objects that it was not trained for, honest messages shift, lose and add more boxes
than they did where it was calibrated. What that world is like nobody knows beforehand. So the calibrated world stands
beside others in which everything that changes does so by a factor more, and the session learns which fits. Only what
honest messages show is stretched so; what attacks show is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import FloatArray

STRETCHES = (1.0, 1.4, 2.0, 2.8)
"""How many times more changes in each of the worlds."""
PRIOR = (0.85, 0.1, 0.035, 0.015)
"""How likely each is beforehand."""
FORGETTING = 0.02
"""Each frame the weights of the worlds go back towards the prior by this share."""


TESTS = ("ego", "pair", "change")
"""What is learned apart: fusions may lose boxes as they did where likelihoods were calibrated, and yet flicker more."""


@dataclass
class Strangeness:
    """Mutable while a frame is judged."""

    weights: dict[str, FloatArray] = field(default_factory=lambda: {test: np.array(PRIOR) for test in TESTS})
    """By test, (len(STRETCHES),): how likely each world is; they sum to 1."""

    def step(self) -> None:
        """Another frame."""
        for test, weights in self.weights.items():
            self.weights[test] = (1 - FORGETTING) * weights + FORGETTING * np.array(PRIOR)

    def learn(self, test: str, likelihood: FloatArray, cells: FloatArray, weight: float) -> None:
        """Take in a finding: its likelihood (worlds, cells) in each world, the probability of what is true (cells,),
        and what it counts.
        """
        weights = self.weights[test] * np.maximum(likelihood @ cells, 1e-12) ** weight
        self.weights[test] = weights / weights.sum()

    def to_state(self) -> dict[str, list[float]]:
        """What `from_state` reads."""
        return {test: [round(float(w), 9) for w in weights] for test, weights in self.weights.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Sequence[float]] | Sequence[float]) -> Strangeness:
        """What `to_state` wrote; with anything else, as earlier versions kept it, nothing is learned yet."""
        if not isinstance(state, Mapping):
            return cls()
        weights = {test: np.array(state[test], dtype=np.float64) for test in TESTS}
        return cls({test: values / values.sum() for test, values in weights.items()})


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
