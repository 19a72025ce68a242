"""The static team: find trustworthy teammates once, then rely on them, and look again now and then."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from robosac.answers import Distrust, Reason, Source, Verdict
from robosac.defenses.protocol import (
    Conversation,
    Decision,
    Hypothesis,
    Outcome,
    Rejection,
    State,
    explain_rejections,
    remembered,
    trusted_in,
)
from robosac.defenses.sampling import Sampling

DEFAULT_RECHECK = 10


class StaticTeam(Sampling):
    """Find trustworthy teammates once, rely on them, and look again now and then.

    The paper's static team, with a re-check.

    1. Until there is a consensus, Algorithm 1. Its subset becomes the trust list.
    2. From then on, the answer is the fusion of the trusted teammates that are present. That is one pass a frame, and
       none of the ego alone.
    3. Every ``recheck_every`` frames the trusted fusion is compared with the ego again. A dissensus empties the list,
       and the frame goes on with 1. (The paper never looks again; but a trusted vehicle can be hijacked.) No evidence,
       or no time, leaves the list as it is, and the next frame tries again.

    The list survives frames in which trusted teammates are missing. If none of them is there, the frame is sampled as
    in 1, and the teammates it finds in consensus are added.
    """

    kind: Literal["static_team"] = "static_team"
    recheck_every: int | None = Field(
        DEFAULT_RECHECK, ge=1, description="Frames between two re-checks of the trusted; null never looks again."
    )

    def initial_state(self, team: Sequence[str]) -> State:  # noqa: ARG002
        """Nobody is trusted; ``frames_since_check`` counts from the latest consensus."""
        return remembered({"frames_since_check": 0}, trusted=())

    def change_team(self, state: State, team: Sequence[str]) -> State:
        """Those who left are no longer trusted; those who joined are not trusted yet."""
        return remembered(state, trusted=[name for name in trusted_in(state) if name in team])

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Answer from the trust list, re-check it, or build it."""
        outcomes: list[Outcome] = []
        trusted: Sequence[str] = trusted_in(state)
        present: Hypothesis = tuple(name for name in team if name in trusted)
        waited = int(state["frames_since_check"]) + 1
        if present and self.recheck_every is not None and waited >= self.recheck_every:
            outcomes.extend((yield [present]))
        verdict = outcomes[0].verdict if outcomes else Verdict.NO_EVIDENCE
        if present and verdict is Verdict.NO_EVIDENCE:
            accepted, source = present, Source.TRUSTED
        elif present and verdict is Verdict.CONSENSUS:
            accepted, source, waited = present, Source.CONSENSUS, 0
        else:
            kept = [] if present else trusted
            accepted = yield from self.search(team, rng, outcomes, spent=len(outcomes))
            trusted = [*kept, *(name for name in accepted if name not in kept)]
            source, waited = Source.CONSENSUS if accepted else Source.EGO_ONLY, 0
        untrusted = Rejection(Reason.DISTRUSTED, distrust=Distrust.UNTRUSTED)
        otherwise = untrusted if source is Source.TRUSTED else Rejection(Reason.NOT_SAMPLED)
        return Decision(
            accepted=accepted,
            source=source,
            rejected=explain_rejections(team, accepted, outcomes, otherwise),
            attacker_ratio=self.attacker_ratio,
            state=remembered({"frames_since_check": waited}, trusted=trusted),
        )
