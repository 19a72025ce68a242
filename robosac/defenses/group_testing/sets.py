"""Tables over the states of up to a handful of teammates: digit i, in base 3, of an entry's number is member i's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, reduce

import numpy as np

from robosac import decimals
from robosac.boxes import FloatArray, IntArray

PLAIN, COMPLEMENTARY, ATTACKS = range(3)
"""States of a teammate: benign; benign, and it sees much of what the others do not; attacker."""
BENIGN = COMPLEMENTARY
"""No state of a benign teammate is above."""
STATES = 3
_UP_TO = (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
"""From state (rows) to all that are not below it."""
COMPLEMENTARY_TEAMS = 0.4
COMPLEMENTARY_MEMBERS = 0.3
"""Share of teams some of whose views complement the others', and of such members among the benign of those teams."""


@lru_cache(maxsize=16)
def states(n: int) -> IntArray:
    """State of each of n members in each of the 3 ** n entries, (n, 3 ** n)."""
    return np.arange(STATES**n)[None] // STATES ** np.arange(n)[:, None] % STATES


@lru_cache(maxsize=16)
def attacking(n: int) -> FloatArray:
    """1 where a member attacks (n, 3 ** n), 0 elsewhere."""
    mask: FloatArray = (states(n) == ATTACKS).astype(np.float64)
    return mask


@lru_cache(maxsize=16)
def unattacked(n: int) -> FloatArray:
    """1 for entries (3 ** n,) in which nobody attacks, 0 for the others."""
    mask: FloatArray = (states(n) != ATTACKS).all(axis=0).astype(np.float64)
    return mask


@lru_cache(maxsize=16)
def codes(n: int) -> IntArray:
    """Of each subset of n members (2 ** n,), by its bits, the sum of ``3 ** i`` over its members."""
    members = np.arange(1 << n)[:, None] >> np.arange(n) & 1
    return members @ STATES ** np.arange(n)


@lru_cache(maxsize=16)
def _attackers(n: int) -> IntArray:
    """Of each entry (3 ** n,) the bits of those that attack."""
    bits: IntArray = (1 << np.arange(n)) @ (states(n) == ATTACKS)
    return bits


@lru_cache(maxsize=16)
def _by_attackers(n: int) -> FloatArray:
    """Matrix (3 ** n, 2 ** n) that sums entries by who attacks."""
    return np.eye(1 << n)[_attackers(n)]


@lru_cache(maxsize=16)
def views(n: int) -> FloatArray:
    """Prior probability (3 ** n,) of who is complementary, given who attacks: in most teams nobody, in the others each
    benign member independently.
    """
    complementary, benign = (states(n) == COMPLEMENTARY).sum(axis=0), (states(n) != ATTACKS).sum(axis=0)
    drawn = COMPLEMENTARY_MEMBERS**complementary * (1 - COMPLEMENTARY_MEMBERS) ** (benign - complementary)
    prior: FloatArray = (1 - COMPLEMENTARY_TEAMS) * (complementary == 0) + COMPLEMENTARY_TEAMS * drawn
    return prior


def forgotten_views(table: FloatArray, sizes: IntArray | None = None) -> FloatArray:
    """Tables (B, K, 3 ** n) after what was known of who is complementary is forgotten; sizes as of `through`."""
    n = members(table)
    prior = views(n) if sizes is None else np.stack([_padded_views(n, size) for size in sizes.tolist()])[:, None]
    return (table @ _by_attackers(n))[..., _attackers(n)] * prior


@lru_cache(maxsize=64)
def _padded_views(n: int, size: int) -> FloatArray:
    """`views` (3 ** n,) of so many members, filled up with members that are plain."""
    padded = np.zeros(STATES**n)
    padded[: STATES**size] = views(size)
    return padded


@lru_cache(maxsize=16)
def prior(n: int, attacker_prior: float) -> FloatArray:
    """Table (1, 3 ** n) of members each of whom attacks with the same probability."""
    attacking = (states(n) == ATTACKS).sum(axis=0)
    table: FloatArray = attacker_prior**attacking * (1 - attacker_prior) ** (n - attacking) * views(n)
    return table[None]


def members(table: FloatArray) -> int:
    """n of a table (..., 3 ** n)."""
    return round(math.log(table.shape[-1], STATES))


def through(table: FloatArray, kernel: FloatArray, sizes: IntArray | None = None) -> FloatArray:
    """Tables (B, K, 3 ** n) after each member went through a transition kernel (3, 3).

    Of each block only the first members do, as many as its size (B,) says; by default all.
    """
    n = members(table)
    moving = (n,) if sizes is None else tuple(sizes.tolist())
    return _each(table, *_halves(tuple(kernel.ravel().tolist()), n, moving))


def at_most(table: FloatArray) -> FloatArray:
    """Tables (B, K, 3 ** n) of the probability that no member's state is above its state in the entry."""
    n = members(table)
    return _each(table, *_halves(_UP_TO, n, (n,)))


def _each(table: FloatArray, first: FloatArray, last: FloatArray) -> FloatArray:
    """Tables (B, K, 3 ** n) after a matrix was applied to each member, given as `_halves` gives it."""
    split = table.reshape(*table.shape[:-1], last.shape[-1], first.shape[-1])
    through_all: FloatArray = (last @ (split @ first)).reshape(table.shape)
    return through_all


@lru_cache(maxsize=256)
def _halves(matrix: tuple[float, ...], n: int, moving: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """A matrix (3, 3) for each of the first ``moving`` (B,) of n members, as one matrix (B, 1, 3 ** m, 3 ** m) for the
    states of the first half of the members, and one, to be applied from the left, for those of the others: two products
    of some size take far less time than n small ones.
    """
    half, one = (n + 1) // 2, np.reshape(matrix, (STATES, STATES))
    first, last = [], []
    for count in moving:
        of_each = [one if member < count else np.eye(STATES) for member in range(n)]
        low, high = (reduce(lambda m, k: np.kron(k, m), part, np.eye(1)) for part in (of_each[:half], of_each[half:]))
        first.append(low)
        last.append(high.T)
    return np.stack(first)[:, None], np.stack(last)[:, None]


def joint(low: FloatArray, high: FloatArray) -> FloatArray:
    """Tables (K, 3 ** (n + m)) of two groups that are independent given the kind, from (K, 3 ** n) and (K, 3 ** m)."""
    return (high[:, :, None] * low[:, None, :]).reshape(len(low), -1)


def marginal(table: FloatArray, kept: Sequence[int]) -> FloatArray:
    """Tables (K, 3 ** m) of some of the members (ascending), summed over what the others of (K, 3 ** n) may be."""
    n = members(table)
    others = tuple(n - i for i in range(n) if i not in kept)  # axis 0 is the kind, axis 1 the last member
    part: FloatArray = table.reshape(len(table), *[STATES] * n).sum(axis=others).reshape(len(table), -1)
    return part


@lru_cache(maxsize=1024)
def by_level(n: int, a: int, d: int) -> FloatArray:
    """Matrix (9, 3 ** n) that gives each entry what belongs to its `levels`."""
    return np.eye(STATES**2)[:, levels(n, a, d)]


def levels(n: int, a: int, d: int) -> IntArray:
    """Of each entry (3 ** n,), the greatest states in subsets ``a`` and ``d`` (their bits): ``3 * in_a + in_d``."""
    bits = 1 << np.arange(n)[:, None]
    in_a, in_d = ((states(n) * (bits & subset != 0)).max(axis=0, initial=0) for subset in (a, d))
    where: IntArray = STATES * in_a + in_d
    return where


def transition(hijack: float, recovery: float) -> FloatArray:
    """Kernel (3, 3) from state (rows) to state."""
    return np.array([[1 - hijack, 0, hijack], [0, 1 - hijack, hijack], [recovery, 0, 1 - recovery]])


def awakened(
    table: FloatArray, team: int, hijack: float, attacker_prior: float, sizes: IntArray | None = None
) -> FloatArray:
    """Tables (B, K, 3 ** n) of members of a team that was benign, after attackers may have awoken.

    Each teammate is hijacked by itself; or, at the same chance that anybody is, all that attack awake together, as they
    would have been drawn beforehand. Either story has half the probability.

    Parameters
    ----------
    table : (B, K, 3 ** n) ndarray
        Of the benign team.
    team : int
        Members of the whole team.
    hijack : float
        Probability that a benign member turns into an attacker.
    attacker_prior : float
        Probability of each teammate to attack if anybody does.
    sizes : (B,) int ndarray, optional
        As of `through`.
    """
    if not team:
        return table
    benign, nobody = (1 - hijack) ** team, (1 - attacker_prior) ** team
    alone = through(table, transition(hijack, 0.0), sizes)
    drawn = through(table, transition(attacker_prior, 0.0), sizes)
    together = (1 - benign) * (drawn - nobody * table) / (1 - nobody) + benign * table
    return (alone + together) / 2


def products_but(each: FloatArray) -> FloatArray:
    """For each factor (n, ...), the product of all others."""
    before, after = np.ones((2, *each.shape))
    np.cumprod(each[:-1], axis=0, out=before[1:])
    np.cumprod(each[:0:-1], axis=0, out=after[-2::-1])
    product: FloatArray = before * after
    return product


def short(values: FloatArray) -> str:
    """The values (n,) in [0, 1] to seven decimals.

    Nothing is lost by it: in the next frame the hazards make more likely than that what is rounded away.
    """
    return decimals.as_text(values, 7)


def long(kept: str | Sequence[Sequence[float]], size: int) -> FloatArray:
    """The array (size,) that `short` was given, but for its rounding.

    States of older versions hold the places of those that are not 0, and these.
    """
    if isinstance(kept, str):
        return decimals.from_text(kept)
    values = np.zeros(size)
    values[np.asarray(kept[0], dtype=np.int64)] = kept[1]
    return values
