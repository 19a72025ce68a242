"""Tables over all subsets of up to a handful of teammates: entry i is the subset of the bits set in i."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from robosac.boxes import FloatArray, IntArray


@lru_cache(maxsize=16)
def bits(n: int) -> IntArray:
    """Which of n members are in each of the 2 ** n subsets, (n, 2 ** n)."""
    bits: IntArray = (np.arange(1 << n)[None] >> np.arange(n)[:, None]) & 1
    return bits


def through(table: FloatArray, kernel: FloatArray) -> FloatArray:
    """Tables (K, 2 ** n) after each member went through a transition kernel (2, 2)."""
    for bit in range(table.shape[1].bit_length() - 1):
        view = table.reshape(len(table), -1, 2, 1 << bit)
        table = np.einsum("kjsi,st->kjti", view, kernel).reshape(len(table), -1)
    return table


def product_but(each: Sequence[FloatArray], index: int) -> FloatArray:
    """The product of all but one."""
    product = np.ones_like(each[0])
    for i, factor in enumerate(each):
        if i != index:
            product = product * factor
    return product


def short(values: FloatArray) -> list[float]:
    """Seven decimals: what is less likely is as likely as what the next frame's hazards let happen."""
    digits: list[float] = values.round(7).tolist()
    return digits


def awakened(n: int, team: int, kernel: FloatArray, attacker_prior: float) -> FloatArray:
    """Table (1, 2 ** n) of n members of a team that was benign, after attackers may have awoken.

    Each teammate is hijacked by itself; or, at the same chance that anybody is, all that attack awake together, as they
    would have been drawn beforehand. Either story has half the probability.

    Parameters
    ----------
    n, team : int
        Members of the table, and of the whole team.
    kernel : (2, 2) ndarray
        From benign or attacker (rows) to benign or attacker.
    attacker_prior : float
        Probability of each teammate to attack if anybody does.
    """
    benign, honest = kernel[0, 0] ** team, 1 - attacker_prior
    nobody = honest**team
    start = np.zeros((1, 1 << n))
    start[0, 0] = 1.0
    alone = through(start, kernel)
    attacking = bits(n).sum(axis=0)[None]
    drawn = attacker_prior**attacking * honest ** (n - attacking)
    together = (1 - benign) * (drawn - nobody * start) / (1 - nobody) + benign * start
    table: FloatArray = (alone + together) / 2
    return table
