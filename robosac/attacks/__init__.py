"""Attacks on the messages of teammates."""

from robosac.attacks.base import IterativeAttack, inverted_pseudo_truth
from robosac.attacks.pgd import PGD

ATTACKS: dict[str, type[IterativeAttack]] = {attack.name: attack for attack in (PGD,)}
"""All attacks by name."""

__all__ = ["ATTACKS", "PGD", "IterativeAttack", "inverted_pseudo_truth"]
