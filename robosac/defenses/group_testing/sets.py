"""Tables over all subsets of up to a handful of teammates: entry i is the subset of the bits set in i."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from robosac.boxes import FloatArray, IntArray

NEITHER, IN_A, IN_D, IN_BOTH = range(4)
"""Which of two subsets ``a`` and ``d`` a third one touches."""


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


def joint(low: FloatArray, high: FloatArray) -> FloatArray:
    """Tables (K, 2 ** (n + m)) of two groups that are independent given the kind, from (K, 2 ** n) and (K, 2 ** m)."""
    table: FloatArray = (high[:, :, None] * low[:, None, :]).reshape(len(low), -1)
    return table


def marginal(table: FloatArray, kept: Sequence[int]) -> FloatArray:
    """Tables (K, 2 ** m) of some of the members (ascending), summed over what the others of (K, 2 ** n) may be."""
    n = table.shape[1].bit_length() - 1
    others = tuple(n - i for i in range(n) if i not in kept)  # axis 0 is the kind, axis 1 the last member
    part: FloatArray = table.reshape(len(table), *[2] * n).sum(axis=others).reshape(len(table), -1)
    return part


def packed(sizes: Sequence[int], room: int) -> list[list[int]]:
    """Items in bins, first fit by decreasing size: their indices, bin by bin."""
    bins: list[list[int]] = []
    for item in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        fit = next((b for b in bins if sum(sizes[i] for i in b) + sizes[item] <= room), None)
        if fit is None:
            bins.append([item])
        else:
            fit.append(item)
    return bins


@lru_cache(maxsize=1024)
def touching(n: int, a: int, d: int) -> IntArray:
    """Of each of the subsets of n members (2 ** n,), whether it touches the subsets ``a`` and ``d``: `NEITHER`, `IN_A`,
    `IN_D` or `IN_BOTH`.
    """
    subsets = np.arange(1 << n)
    where: IntArray = IN_A * (subsets & a != 0) + IN_D * (subsets & d != 0)
    return where


def products_but(each: Sequence[FloatArray]) -> FloatArray:
    """For each factor (n, ...), the product of all others."""
    before, after = np.ones((2, len(each), *each[0].shape))
    np.cumprod(each[:-1], axis=0, out=before[1:])
    np.cumprod(each[:0:-1], axis=0, out=after[-2::-1])
    product: FloatArray = before * after
    return product


def short(values: FloatArray) -> list[float]:
    """Seven decimals: what is less likely is as likely as what the next frame's hazards let happen."""
    digits: list[float] = values.round(7).tolist()
    return digits


def transition(hijack: float, recovery: float) -> FloatArray:
    """Kernel (2, 2) from benign or attacker (rows) to benign or attacker."""
    return np.array([[1 - hijack, hijack], [recovery, 1 - recovery]])


@lru_cache(maxsize=64)
def awakened(n: int, team: int, hijack: float, recovery: float, attacker_prior: float) -> FloatArray:
    """Table (1, 2 ** n) of n members of a team that was benign, after attackers may have awoken.

    Each teammate is hijacked by itself; or, at the same chance that anybody is, all that attack awake together, as they
    would have been drawn beforehand. Either story has half the probability.

    Parameters
    ----------
    n, team : int
        Members of the table, and of the whole team.
    hijack, recovery : float
        Probability that a benign member turns into an attacker, and the other way round.
    attacker_prior : float
        Probability of each teammate to attack if anybody does.
    """
    kernel = transition(hijack, recovery)
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
