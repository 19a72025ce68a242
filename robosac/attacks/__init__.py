"""Attacks on the messages of teammates."""

from robosac.attacks.adaptive import Erase
from robosac.attacks.base import Attack, IterativeAttack, Knowledge, inverted_pseudo_truth
from robosac.attacks.carlini_wagner import CarliniWagner
from robosac.attacks.gradient import BIM, PGD
from robosac.attacks.noise import GaussianNoise

ATTACKS: dict[str, type[Attack]] = {attack.name: attack for attack in (PGD, BIM, CarliniWagner, GaussianNoise, Erase)}
"""All attacks by name."""

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
]
