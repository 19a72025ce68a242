"""A defence that names attackers; see `GroupTesting`."""

from __future__ import annotations

from robosac.defenses.group_testing.calibration import Calibration
from robosac.defenses.group_testing.defense import GroupTesting, GroupTestingSettings
from robosac.defenses.group_testing.model import OPEN, CalibrationError, EvidenceModel
from robosac.defenses.group_testing.posterior import Hazards

__all__ = [
    "OPEN",
    "Calibration",
    "CalibrationError",
    "EvidenceModel",
    "GroupTesting",
    "GroupTestingSettings",
    "Hazards",
]
