"""Whom to ask next and whom to believe: one file a defence."""

from __future__ import annotations

from robosac.defenses.protocol import (
    Conversation,
    Decision,
    Defense,
    Hypothesis,
    Outcome,
    Reason,
    Rejection,
    Source,
    State,
)
from robosac.defenses.sample_consensus import SampleConsensus

__all__ = [
    "Conversation",
    "Decision",
    "Defense",
    "Hypothesis",
    "Outcome",
    "Reason",
    "Rejection",
    "SampleConsensus",
    "Source",
    "State",
]
