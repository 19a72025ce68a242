"""One by one: test every teammate alone, then all that passed together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from robosac.answers import Verdict
from robosac.defenses.memoryless import Memoryless, decide, unite
from robosac.defenses.protocol import Conversation, Hypothesis, Outcome, State
from robosac.defenses.settings import ConsensusSettings


@dataclass(frozen=True)
class OneByOne(Memoryless):
    """Individual testing, which is the cheapest search where more than about four in ten attack.

    1. Test each teammate alone against the ego, in random order, so that a deadline hits nobody in particular.
    2. Fuse all that are in consensus, and test that fusion; if it fails, the answer is the best of them.

    S + 1 tests a frame at most, whoever attacks. The settings are those of `Memoryless`.
    """

    kind: ClassVar[str] = "one_by_one"

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 and 2."""
        outcomes: list[Outcome] = []
        singles: list[Hypothesis] = [(team[i],) for i in rng.permutation(len(team))]
        if singles:
            outcomes.extend((yield singles))
        passed = [o.teammates[0] for o in outcomes if o.verdict is Verdict.CONSENSUS]
        accepted = yield from unite(team, passed, outcomes)
        return decide(team, accepted, outcomes, state)


class OneByOneSettings(ConsensusSettings):
    """Test every teammate alone, then all that passed together."""

    makes = OneByOne
    kind: Literal["one_by_one"]
