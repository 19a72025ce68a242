"""What is compared: attacks with numbers of attackers, defences, and how many frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robosac.attacks import HONEST, load_campaign
from robosac.calibrated import calibration_of
from robosac.defenses import (
    A2CP,
    Conformal,
    Defense,
    GroupTesting,
    Halving,
    OneByOne,
    SampleConsensus,
    StaticTeam,
    Undefended,
)
from robosac.detectors import Detector

TEAMMATES = 5
"""Of the ego, in every test scene."""

DEFENSES: Mapping[str, Callable[[Detector], Defense]] = {
    "no defence": lambda _: Undefended(),
    "sample_consensus": lambda _: SampleConsensus(0.2, sampling_budget=7, collaborators=3),
    "static_team": lambda _: StaticTeam(0.2, sampling_budget=7, collaborators=3),
    "a2cp": lambda _: A2CP(),
    "group_testing": lambda detector: GroupTesting.calibrated(calibration_of(detector.info), pose_error_m=0.0),
    "group_testing, expecting .2 m": lambda detector: GroupTesting.calibrated(calibration_of(detector.info)),
    "halving": lambda _: Halving(),
    "one_by_one": lambda _: OneByOne(),
    "conformal": lambda _: Conformal(),
}
"""The defences by the names they have in the report; each is made for a detector, as it may be calibrated for it."""


@dataclass(frozen=True)
class Setting:
    """What a team is up against.

    Attributes
    ----------
    campaign : str
        As `robosac.attacks.load_campaign` takes it.
    attackers : int
        Among the five teammates of car-1.
    """

    campaign: str
    attackers: int

    @classmethod
    def parse(cls, text: str) -> Setting:
        """Read ``CAMPAIGN:NUMBER``; a campaign may hold colons itself.

        Raises
        ------
        ValueError
            If there is no such campaign, or no number from 0 to `TEAMMATES`.
        """
        campaign, _, number = text.rpartition(":")
        if not campaign or not number.isdecimal() or int(number) > TEAMMATES:
            raise ValueError(f"{text!r} is not CAMPAIGN:NUMBER with a number from 0 to {TEAMMATES}")
        load_campaign(campaign)
        return cls(campaign, int(number)) if int(number) else NOBODY

    @property
    def label(self) -> str:
        """For tables: the campaign and the number of attackers."""
        return f"{self.campaign} x {self.attackers}" if self.attackers else "nobody attacks"


@dataclass(frozen=True)
class Extent:
    """How much is run.

    Attributes
    ----------
    settings : tuple of Setting
    scenes, frames : int
        Test sequences at 5 Hz, the first scenes, and frames of each; more than 5.
    """

    settings: tuple[Setting, ...]
    scenes: int
    frames: int


NOBODY = Setting(HONEST, 0)


def _settings(*numbers: tuple[str, int]) -> tuple[Setting, ...]:
    return (NOBODY, *(Setting(campaign, attackers) for campaign, attackers in numbers))


FULL = Extent(
    settings=_settings(
        *((attack, n) for attack in ("pgd", "bim", "cw") for n in (1, 2, 3, 4)),
        *(("erase", n) for n in (1, 2)),
        *(("invent", n) for n in (1, 2)),
        *(("shift", n) for n in (1, 2)),
        ("erase-still", 1),
        ("invent-still", 1),
        ("invent-steady", 1),
        ("shift-still", 1),
        ("pgd@asleep", 1),
        ("erase@asleep", 1),
        ("erase@asleep", 2),
        ("invent@asleep", 1),
        ("pgd@flicker", 1),
        ("erase@flicker", 1),
        ("erase@turns", 2),
        ("pgd@covering", 2),
        ("pgd@covering@asleep", 2),
        ("pgd@framing", 1),
        ("honest@false-pose", 1),
    ),
    scenes=40,
    frames=25,
)
QUICK = Extent(
    settings=_settings(
        *(("pgd", n) for n in (1, 2, 3)),
        ("erase", 1),
        ("erase", 2),
        ("invent", 1),
        ("shift", 1),
        ("invent-still", 1),
        ("erase@asleep", 1),
        ("pgd@covering", 2),
        ("honest@false-pose", 1),
    ),
    scenes=2,
    frames=15,
)
