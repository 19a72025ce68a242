"""Whom to ask next and whom to believe: one file a defence."""

from __future__ import annotations

from robosac.defenses.a2cp import A2CP
from robosac.defenses.building import build
from robosac.defenses.conformal import Conformal
from robosac.defenses.group_testing import GroupTesting
from robosac.defenses.halving import Halving
from robosac.defenses.one_by_one import OneByOne
from robosac.defenses.protocol import (
    Conversation,
    Decision,
    Defense,
    Hypothesis,
    Outcome,
    Reason,
    Reference,
    Rejection,
    Source,
    State,
    named_in,
    remembered,
    suspicion_in,
    trusted_in,
)
from robosac.defenses.sample_consensus import SampleConsensus
from robosac.defenses.static_team import StaticTeam
from robosac.defenses.undefended import Undefended

__all__ = [
    "A2CP",
    "Conformal",
    "Conversation",
    "Decision",
    "Defense",
    "Halving",
    "GroupTesting",
    "Hypothesis",
    "OneByOne",
    "Outcome",
    "Reason",
    "Reference",
    "Rejection",
    "SampleConsensus",
    "Source",
    "State",
    "StaticTeam",
    "Undefended",
    "build",
    "named_in",
    "remembered",
    "suspicion_in",
    "trusted_in",
]
