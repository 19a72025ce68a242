"""Recursive halving: split the team until every group agrees with the ego or is a single teammate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from robosac.answers import Verdict
from robosac.defenses.memoryless import Memoryless, unite
from robosac.defenses.protocol import Conversation, Hypothesis, Outcome, State, conclude


class Halving(Memoryless):
    """Split the team until every group agrees with the reference or is a single teammate.

    The idea of PASAC (*CP-Guard*, AAAI 2025): sample consensus that needs no attacker ratio.

    1. Test the whole team against the ego.
    2. A group in consensus passes as a whole. A group in dissensus is split in two at random, and both halves are
       tested; a single teammate in dissensus is left out.
    3. All that passed are fused and tested once more, since groups that pass apart need not agree together; if that
       fails, the answer is the largest group that passed.

    With nobody attacking that is one test, with A attackers of S at most ``2 A ceil(log2 S) + 2``. A group without
    evidence passes nothing and is not split.
    """

    kind: Literal["halving"] = "halving"

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 to 3; the groups of one depth are a batch."""
        outcomes: list[Outcome] = []
        passed: set[str] = set()
        groups: list[Hypothesis] = [tuple(team)] if team else []
        while groups:
            tested = yield groups
            outcomes.extend(tested)
            passed.update(*(o.teammates for o in tested if o.verdict is Verdict.CONSENSUS))
            if len(tested) < len(groups):
                break
            divided = [o.teammates for o in tested if o.verdict is Verdict.DISSENSUS and len(o.teammates) > 1]
            groups = [half for group in divided for half in _split(group, rng)]
        accepted = yield from unite(team, passed, outcomes)
        return conclude(team, accepted, outcomes, state)


def _split(group: Hypothesis, rng: np.random.Generator) -> list[Hypothesis]:
    """Two random halves, each in the group's order; the first is the smaller one."""
    first = {int(i) for i in rng.permutation(len(group))[: len(group) // 2]}
    return [
        tuple(name for i, name in enumerate(group) if i in first),
        tuple(name for i, name in enumerate(group) if i not in first),
    ]
