"""No defence: fuse everybody. A baseline, and what a gateway without an adversary would do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from robosac.answers import Source
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.protocol import Conversation, Decision, Reference, State, remembered
from robosac.defenses.settings import DefenseSettings


class Undefended(DefenseSettings):
    """No defence: everybody is fused and nothing is tested. A baseline.

    Every teammate is on the trust list from the start, because whoever chose this says so.
    """

    consensus_threshold: ClassVar[float] = DEFAULT_THRESHOLD
    reference: ClassVar[Reference] = Reference.EGO

    kind: Literal["none"] = "none"

    def initial_state(self, team: Sequence[str]) -> State:
        return remembered({}, trusted=team)

    def change_team(self, state: State, team: Sequence[str]) -> State:  # noqa: ARG002
        return self.initial_state(team)

    def check_team(self, team_size: int) -> None: ...

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:  # noqa: ARG002
        """Fuse all that are present."""
        yield from ()
        source = Source.TRUSTED if team else Source.EGO_ONLY
        return Decision(tuple(team), source, rejected={}, attacker_ratio=None, state=state)
