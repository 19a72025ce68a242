"""Attacks on the messages of teammates."""

from __future__ import annotations

from robosac import references
from robosac.attacks.adaptive import Erase
from robosac.attacks.base import Attack, IterativeAttack, Knowledge, inverted_pseudo_truth
from robosac.attacks.carlini_wagner import CarliniWagner
from robosac.attacks.gradient import BIM, PGD
from robosac.attacks.noise import GaussianNoise

ATTACKS: dict[str, type[Attack]] = {attack.name: attack for attack in (PGD, BIM, CarliniWagner, GaussianNoise, Erase)}
"""All attacks by name."""


def load(attack: str) -> Attack:
    """Make an attack.

    Parameters
    ----------
    attack : str
        A name of `ATTACKS`, or ``module:callable``, where the callable takes no arguments and returns an attack of the
        user's own.

    Raises
    ------
    ValueError
        If there is no such attack.
    """
    if attack in ATTACKS:
        return ATTACKS[attack]()
    if not references.is_reference(attack):
        raise ValueError(f"unknown attack {attack!r}; known: {', '.join(ATTACKS)}; or give module:callable")
    made = references.make(attack)
    if not isinstance(made, Attack):
        raise ValueError(f"{attack} made no attack but {made!r:.200}")
    return made


__all__ = [
    "ATTACKS",
    "BIM",
    "PGD",
    "Attack",
    "CarliniWagner",
    "Erase",
    "GaussianNoise",
    "IterativeAttack",
    "Knowledge",
    "inverted_pseudo_truth",
    "load",
]
