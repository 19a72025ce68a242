"""Attacks on the messages of teammates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robosac.attacks.adaptive import Erase, Invent, InventSteady, Shift
from robosac.attacks.base import Attack, IterativeAttack
from robosac.attacks.campaign import BEHAVIOURS, HONEST, SEPARATOR, Campaign
from robosac.attacks.carlini_wagner import CarliniWagner
from robosac.attacks.denial import Deny
from robosac.attacks.geometric import NoGeometry
from robosac.attacks.ghosts import Ghost, GhostAhead, GhostDriving, GhostHidden, Ghosts, Swarm
from robosac.attacks.gradient import BIM, PGD
from robosac.attacks.hearing import Hearing, NoWitness
from robosac.attacks.noise import GaussianNoise
from robosac.attacks.objects import OnObjects
from robosac.attacks.replays import Copy, Elsewhere, Frozen, Replay, Stale
from robosac.attacks.requirements import lacking
from robosac.attacks.returned import AttackError
from robosac.attacks.situation import Foreign, Lie, Past, Situation
from robosac.attacks.still import EraseStill, InventStill, ShiftStill
from robosac.attacks.vehicles import Dim, Displace, GhostBeside, Jump, OnVehicles, Remove, RemoveMany, Stretch, Turn
from robosac.plugins import Kind

KIND: Kind[Attack] = Kind("attack", __name__, Attack)
ATTACKS: Mapping[str, type[Attack]] = dict(sorted(KIND.shipped.items()))
"""All attacks that ship, by name."""


CAMPAIGN_HELP = (
    f"One of {', '.join(ATTACKS)}, or module:callable, or {HONEST}; after it, if wanted, {SEPARATOR} and one of "
    f"{', '.join(BEHAVIOURS)}."
)
"""What `load_campaign` takes, for the help of a command."""


def load(attack: str) -> Attack:
    """Make an attack.

    Parameters
    ----------
    attack : str
        A name of `ATTACKS`, an entry point of the group ``robosac.attacks``, or ``module:callable``, where the callable
        takes no arguments and returns an attack.

    Raises
    ------
    ValueError
        If there is no such attack.
    """
    return KIND.make(attack)


def load_campaign(spec: str) -> Campaign:
    """Make a campaign.

    Parameters
    ----------
    spec : str
        ``attack`` or ``attack@behaviour@...``: an attack as `load` takes it, or ``honest``, and names of `BEHAVIOURS`.

    Raises
    ------
    ValueError
        If there is no such attack or behaviour, or they don't go together.
    """
    attack, *behaviours = spec.split(SEPARATOR)
    chosen: dict[str, Any] = {}
    for name in behaviours:
        if name not in BEHAVIOURS:
            raise ValueError(f"unknown behaviour {name!r}; known: {', '.join(BEHAVIOURS)}")
        if other := [field for field, value in BEHAVIOURS[name].items() if chosen.get(field, value) != value]:
            raise ValueError(f"{spec}: {name} does not go with a behaviour before it: both set the {other[0]}")
        chosen.update(BEHAVIOURS[name])
    return Campaign(None if attack == HONEST else load(attack), **chosen)


__all__ = [
    "ATTACKS",
    "BEHAVIOURS",
    "BIM",
    "CAMPAIGN_HELP",
    "HONEST",
    "PGD",
    "Attack",
    "AttackError",
    "Campaign",
    "CarliniWagner",
    "Copy",
    "Deny",
    "Dim",
    "Displace",
    "Elsewhere",
    "Erase",
    "EraseStill",
    "Foreign",
    "Frozen",
    "GaussianNoise",
    "Ghost",
    "GhostAhead",
    "GhostBeside",
    "GhostDriving",
    "GhostHidden",
    "Ghosts",
    "Invent",
    "InventSteady",
    "InventStill",
    "Hearing",
    "IterativeAttack",
    "Jump",
    "Lie",
    "NoGeometry",
    "NoWitness",
    "OnObjects",
    "OnVehicles",
    "Past",
    "Remove",
    "RemoveMany",
    "Replay",
    "Shift",
    "ShiftStill",
    "Situation",
    "Stale",
    "Stretch",
    "Swarm",
    "Turn",
    "lacking",
    "load",
    "load_campaign",
]
