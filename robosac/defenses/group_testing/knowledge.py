"""All that is known within a frame: how likely outcomes are, who is believed to attack, and what is remembered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.boxes import BoolArray, FloatArray
from robosac.defenses.group_testing.memory import KeyArray, Memory, identity
from robosac.defenses.group_testing.model import EvidenceModel
from robosac.defenses.group_testing.posterior import Posterior
from robosac.defenses.protocol import Hypothesis, State, remembered


@dataclass
class Knowledge:
    """Posterior and memory change within a frame; who is in the team does not."""

    model: EvidenceModel
    posterior: Posterior
    memory: Memory
    period_s: float = 0.2
    """Time between two frames."""
    members: list[str] = field(init=False)
    """The team, in the order of every array over teammates; some may be missing in the frame."""
    shown: dict[int, FloatArray] = field(default_factory=dict, init=False)
    """By the sum of its identities: what each subset showed in this frame (n, 4), see `geometry.followed`."""
    shown_before: Mapping[int, FloatArray] = field(default_factory=dict, init=False)
    """As `Memory.shown`, where the frame judged before this one is too long ago to be compared with."""
    frames_since: int = field(default=1, init=False)
    """How many frames ago that one was."""

    def __post_init__(self) -> None:
        self.members = self.posterior.members
        self._rows: dict[Hypothesis, BoolArray] = {}
        self._index = {name: i for i, name in enumerate(self.members)}
        self._numbers = {name: identity(name) for name in self.members}
        self._identities = np.array(list(self._numbers.values()), dtype=np.uint64)

    def rows(self, subsets: Sequence[Hypothesis]) -> BoolArray:
        """Subsets as rows (n, S) of booleans over the members."""
        rows = np.empty((len(subsets), len(self.members)), dtype=bool)
        for row, subset in enumerate(subsets):
            known = self._rows.get(subset)
            if known is None:
                known = self._rows[subset] = np.zeros(len(self.members), dtype=bool)
                known[[self._index[name] for name in subset]] = True
            rows[row] = known
        return rows

    def names(self, row: BoolArray, team: Hypothesis) -> Hypothesis:
        """The subset of a row (S,), in the order of the team."""
        return tuple(name for name in team if row[self._index[name]])

    def keys(self, rows: BoolArray) -> KeyArray:
        """Subsets (n, S) as memory knows them (n,); nobody is 0."""
        return rows @ self._identities

    def key(self, subset: Hypothesis) -> int:
        """As `keys`, of one subset."""
        return sum(self._numbers[name] for name in subset) % 2**64

    def suspicion(self) -> dict[str, float]:
        """Probability that each member attacks."""
        return dict(zip(self.members, self.posterior.marginals().tolist(), strict=True))


def remember(posterior: Posterior, memory: Memory, trusted: Sequence[str], named: Sequence[str]) -> State:
    """The defence's state for the next frame."""
    return remembered(
        {"posterior": posterior.to_state(), "memory": memory.to_state()},
        trusted=trusted,
        named=named,
        suspicion=dict(sorted(zip(posterior.members, posterior.marginals().round(6).tolist(), strict=True))),
    )
