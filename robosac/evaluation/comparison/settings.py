"""What is compared: attacks with numbers of attackers, defences, and how many frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from robosac.attacks import HONEST, load_campaign
from robosac.calibrated import calibration_of
from robosac.defenses import Defense, DefenseSettings, build, read_settings, shipped
from robosac.defenses.group_testing import CalibrationError
from robosac.detectors import Detector

_PAPER = {"sampling_budget": 7, "collaborators": 3}
_AS_PLAYED: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "none": {"no defence": {}},
    "sample_consensus": {"sample_consensus": _PAPER},
    "static_team": {"static_team": _PAPER},
    "a2cp": {"a2cp": {}},
    "group_testing": {"group_testing": {"pose_error_m": 0.0}, "group_testing, expecting .2 m": {"pose_error_m": 0.2}},
}
"""Columns of a kind, and its settings there; any other kind has one column, with its defaults."""

DEFENSES: Mapping[str, DefenseSettings] = {
    name: read_settings({"kind": kind, **settings})
    for kind in dict.fromkeys((*_AS_PLAYED, *shipped()))
    for name, settings in _AS_PLAYED.get(kind, {kind: {}}).items()
}
"""The defences that ship, by the names they have in the report."""


def built(defenses: Mapping[str, DefenseSettings], detector: Detector) -> tuple[dict[str, Defense], dict[str, str]]:
    """The defences themselves, for a detector, as they may be calibrated for it.

    Returns
    -------
    built, left_out : dict of name to Defense, dict of name to str
        Those that the detector lacks a calibration for are left out; each with the reason.

    Raises
    ------
    DomainError
        If one cannot be made of its settings.
    """
    made, left_out = {}, {}
    for name, settings in defenses.items():
        try:
            made[name] = build(settings, lambda: calibration_of(detector.info))
        except CalibrationError as missing:
            left_out[name] = str(missing)
    return made, left_out


def lacks_witness(defenses: Mapping[str, Defense]) -> bool:
    """Whether any of these defences is to judge single objects, and the detector has no witness for it."""
    return any(getattr(each, "lacks_witness", False) for each in defenses.values())


@dataclass(frozen=True)
class Setting:
    """What a team is up against."""

    campaign: str
    """As `robosac.attacks.load_campaign` takes it."""
    attackers: int
    """Among the ego's teammates."""

    @classmethod
    def parse(cls, text: str) -> Setting:
        """Read ``CAMPAIGN:NUMBER``; a campaign may hold colons itself.

        Raises
        ------
        ValueError
            If there is no such campaign, or no number.
        """
        campaign, _, number = text.rpartition(":")
        if not campaign or not number.isdecimal():
            raise ValueError(f"{text!r} is not CAMPAIGN:NUMBER of attackers")
        load_campaign(campaign)
        return cls(campaign, int(number)) if int(number) else NOBODY

    @property
    def label(self) -> str:
        """For tables: the campaign and the number of attackers."""
        return f"{self.campaign} x {self.attackers}" if self.attackers else "nobody attacks"


@dataclass(frozen=True)
class Extent:
    """How much is run."""

    settings: tuple[Setting, ...]
    scenes: int
    frames: int
    """Test sequences, the first scenes, and frames of each; more than 5."""


NOBODY = Setting(HONEST, 0)


def _settings(text: str) -> tuple[Setting, ...]:
    each = (setting.rpartition(":") for setting in text.split())
    return (NOBODY, *(Setting(campaign, int(attackers)) for campaign, _, attackers in each))


FULL = Extent(
    _settings("""
        pgd:1 pgd:2 pgd:3 pgd:4 bim:1 bim:2 bim:3 bim:4 cw:1 cw:2 cw:3 cw:4
        erase:1 erase:2 invent:1 invent:2 shift:1 shift:2 erase-still:1 invent-still:1 invent-steady:1 shift-still:1
        pgd@asleep:1 erase@asleep:1 erase@asleep:2 invent@asleep:1 pgd@flicker:1 erase@flicker:1 erase@turns:2
        pgd@covering:2 pgd@covering@asleep:2 pgd@framing:1 honest@false-pose:1
        ghost:1 ghost:2 ghost-driving:1 ghost-ahead:1 ghosts:1 swarm:1 remove:1 remove:2 remove-many:1 displace:1
        dim:1 jump:1 turn:1 stretch:1 ghost-beside:1
        frozen:1 stale:1 elsewhere:1 copy:1 shift@soft:1 shift@soft:2 shift@soft3:1 erase@soft3:1
        ghost-hidden:1 ghost-framing@vouching:1 deny:1 ghost@denying:1 remove@denying:1 ghost@vouching:2
        displace@soft:1 displace@denying:1 displace@denying:2 displace@denying@double:1 displace@denying@double:2
        frozen@soft:1 frozen@denying:1 frozen@denying:2 frozen@denying@double:1 frozen@denying@double:2
        stale@soft:1 stale@denying:1 stale@denying:2 stale@denying@double:1 stale@denying@double:2
        elsewhere@soft:1 elsewhere@denying:1 elsewhere@denying:2 elsewhere@denying@double:1 elsewhere@denying@double:2
        copy@soft:1 copy@denying:1 copy@denying:2 copy@denying@double:1 copy@denying@double:2
    """),
    scenes=40,
    frames=25,
)
QUICK = Extent(
    _settings("""
        pgd:1 pgd:2 pgd:3 erase:1 erase:2 invent:1 shift:1 invent-still:1
        erase@asleep:1 pgd@covering:2 honest@false-pose:1
    """),
    scenes=2,
    frames=15,
)
