"""A defence that tests as many subsets as it is told."""

from collections.abc import Sequence
from itertools import chain, combinations, islice
from typing import Literal

import numpy as np

from robosac.defenses.memoryless import Memoryless
from robosac.defenses.protocol import Conversation, State, conclude

MANY = "tests.service.many:ManyTests"


class ManyTests(Memoryless):
    """Tests so many subsets one after another, and answers with the first of them that is in consensus."""

    kind: Literal["many_tests"] = "many_tests"
    tests: int = 600

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        subsets = chain.from_iterable(combinations(sorted(team), size) for size in range(1, len(team) + 1))
        outcomes = list((yield list(islice(subsets, self.tests))))
        accepted = outcomes[0].teammates if outcomes and outcomes[0].verdict == "consensus" else ()
        return conclude(team, accepted, outcomes, state)
