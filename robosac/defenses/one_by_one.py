"""One by one: test every teammate alone, then all that passed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from robosac.answers import Verdict
from robosac.defenses.memoryless import Memoryless, one_each, unite
from robosac.defenses.protocol import Conversation, State, conclude


class OneByOne(Memoryless):
    """Test every teammate alone, then all that passed together.

    Individual testing is the cheapest search where more than about four in ten attack.

    1. Test each teammate alone against the ego, in random order, so that a deadline hits nobody in particular.
    2. Fuse all that are in consensus, and test that fusion; if it fails, the answer is the best of them.

    S + 1 tests a frame at most, whoever attacks.
    """

    kind: Literal["one_by_one"] = "one_by_one"

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 and 2."""
        outcomes = yield from one_each(team, rng)
        passed = [o.teammates[0] for o in outcomes if o.verdict is Verdict.CONSENSUS]
        accepted = yield from unite(team, passed, outcomes)
        return conclude(team, accepted, outcomes, state)
