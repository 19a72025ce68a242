"""Whom to ask next and whom to believe: one file a defence."""

from __future__ import annotations

from robosac.answers import Distrust, Reason, Source, Standing, Support, Verdict
from robosac.defenses.a2cp import A2CP
from robosac.defenses.batch import Batch
from robosac.defenses.conformal import Conformal
from robosac.defenses.group_testing import GroupTesting
from robosac.defenses.halving import Halving
from robosac.defenses.one_by_one import OneByOne
from robosac.defenses.protocol import (
    EGO,
    Conversation,
    Decision,
    Defense,
    Difference,
    Hypothesis,
    JudgedBox,
    Outcome,
    Reference,
    Rejection,
    State,
    explain_rejections,
    named_in,
    remembered,
    suspicion_in,
    trusted_in,
)
from robosac.defenses.registry import Kinds, build, known, load, read_settings, shipped
from robosac.defenses.sample_consensus import SampleConsensus
from robosac.defenses.settings import ConsensusSettings, DefenseSettings, check_kinds, check_numbers
from robosac.defenses.static_team import StaticTeam
from robosac.defenses.undefended import Undefended

__all__ = [
    "A2CP",
    "Batch",
    "Conformal",
    "ConsensusSettings",
    "Conversation",
    "Decision",
    "Defense",
    "Difference",
    "DefenseSettings",
    "Distrust",
    "EGO",
    "Halving",
    "GroupTesting",
    "Hypothesis",
    "JudgedBox",
    "Kinds",
    "OneByOne",
    "Outcome",
    "Reason",
    "Reference",
    "Rejection",
    "SampleConsensus",
    "Source",
    "Standing",
    "State",
    "StaticTeam",
    "Support",
    "Undefended",
    "Verdict",
    "build",
    "check_kinds",
    "check_numbers",
    "explain_rejections",
    "known",
    "load",
    "named_in",
    "read_settings",
    "remembered",
    "shipped",
    "suspicion_in",
    "trusted_in",
]
