"""How many hypotheses to test, and how many collaborators can be had for that.

The paper's Eq. 1 and Eq. 2 (*Among Us: Adversarially Robust Collaborative Perception by Consensus*, ICCV 2023) treat
the members of a hypothesis as drawn independently. In truth they are drawn without replacement, and the exact law is
hypergeometric. Both are here: `eq1_collaborators` and `eq2_budget` are the paper's, `exact_budget` and
`exact_collaborators` what the gateway uses. All take these arguments, and raise `DomainError` if one is out of range:

========================  ==========================================================  =========================
``team_size``             S, teammates without the ego                                S >= 1
``attackers``             A, of them                                                  0 <= A <= S
``attacker_ratio``        eta = A / S                                                 0 < eta < 1
``collaborators``         s, members of a hypothesis                                  1 <= s, and s <= S if known
``sampling_budget``       N, hypotheses                                               N >= 1
``confidence``            p, chance that one of the hypotheses has no attacker        0 < p < 1
========================  ==========================================================  =========================

Counts are whole numbers: `DomainError` also for 7.5, or for a text.
"""

from __future__ import annotations

import math
from numbers import Integral, Real

DEFAULT_CONFIDENCE = 0.99
_ENUMERABLE = 100_000
"""Up to so many hypotheses the law of distinct draws is summed up exactly."""
_ROUNDING = 1e-9
"""Slack under which a quotient counts as the whole number it misses by floating point."""


class DomainError(ValueError):
    """An argument lies outside the domain of a budget formula."""


def eq1_collaborators(sampling_budget: int, attacker_ratio: float, confidence: float = DEFAULT_CONFIDENCE) -> int:
    """The paper's Eq. 1: ``floor(ln(1 - (1-p)^(1/N)) / ln(1-eta))``, collaborators guaranteed by a budget.

    At least 0, and not bounded by a team size, which the formula does not know. `DomainError` also if the arguments are
    too close to the ends of their ranges for floating point.
    """
    _check_at_least_one("sampling_budget", sampling_budget)
    _check_open_unit("attacker_ratio", attacker_ratio)
    _check_open_unit("confidence", confidence)
    clean_needed = -math.expm1(math.log1p(-confidence) / sampling_budget)
    try:
        return math.floor(math.log(clean_needed) / math.log1p(-attacker_ratio) + _ROUNDING)
    except (OverflowError, ValueError) as error:
        raise DomainError("the arguments are too close to 0 or 1 for the formula") from error


def eq2_budget(collaborators: int, attacker_ratio: float, confidence: float = DEFAULT_CONFIDENCE) -> int:
    """The paper's Eq. 2: ``ceil(ln(1-p) / ln(1 - (1-eta)^s))``, hypotheses needed for s collaborators.

    At least 1. `DomainError` also if so many collaborators are asked for that N is not a finite number.
    """
    _check_at_least_one("collaborators", collaborators)
    _check_open_unit("attacker_ratio", attacker_ratio)
    _check_open_unit("confidence", confidence)
    return _trials((1.0 - attacker_ratio) ** collaborators, confidence)


def attackers_in_team(team_size: int, attacker_ratio: float) -> int:
    """Attackers that a ratio, here in [0, 1], means for a team: eta * S, rounded up."""
    _check_at_least_one("team_size", team_size)
    if not isinstance(attacker_ratio, Real) or not 0.0 <= attacker_ratio <= 1.0:
        raise DomainError(f"attacker_ratio must be in [0, 1], got {attacker_ratio}")
    return math.ceil(attacker_ratio * team_size - _ROUNDING)


def clean_probability(team_size: int, attackers: int, collaborators: int) -> float:
    """Chance that a random hypothesis holds no attacker: ``q = C(S-A, s) / C(S, s)``.

    0 if more collaborators are asked for than benign teammates exist.
    """
    total, clean = _hypotheses(team_size, attackers, collaborators)
    return clean / total


def exact_budget(
    team_size: int,
    attackers: int,
    collaborators: int,
    confidence: float = DEFAULT_CONFIDENCE,
    *,
    distinct: bool = True,
) -> int:
    """Hypotheses needed to meet an attacker-free one with a given confidence.

    If none is tried twice (``distinct``), the first n tries all fail with probability ``C(D, n) / C(T, n)``, where T
    hypotheses exist and D of them hold an attacker; D + 1 tries always suffice. Otherwise tries are independent:
    ``ceil(ln(1-p) / ln(1-q))``.

    The answer is the least that suffices, at least 1, but for distinct hypotheses when there are more than 100,000 of
    them: then it is the smaller of two bounds that always suffice, the independent one and ``T (1 - (1-p)^(1/(T-D)))``.

    `DomainError` also if no attacker-free hypothesis exists.
    """
    _check_open_unit("confidence", confidence)
    total, clean = _hypotheses(team_size, attackers, collaborators)
    if clean == 0:
        raise DomainError(
            f"no {collaborators} of {team_size} teammates can be free of {attackers} attackers; "
            f"ask for at most {team_size - attackers} collaborators"
        )
    if not distinct:
        return _trials(clean / total, confidence)
    if total > _ENUMERABLE:
        bound = math.ceil(-total * math.expm1(math.log1p(-confidence) / clean))
        return max(1, min(bound, _trials(clean / total, confidence)))
    failure, tries = 1.0, 0
    while failure > (1.0 - confidence) * (1.0 + _ROUNDING):
        failure *= (total - clean - tries) / (total - tries)
        tries += 1
    return max(1, tries)


def exact_collaborators(
    team_size: int,
    attackers: int,
    sampling_budget: int,
    confidence: float = DEFAULT_CONFIDENCE,
    *,
    distinct: bool = True,
) -> int:
    """Most collaborators for which a budget suffices by `exact_budget`; 0 if it does not suffice for one."""
    _check_at_least_one("sampling_budget", sampling_budget)
    _check_open_unit("confidence", confidence)
    _check_team(team_size, attackers, 1)
    for s in range(team_size - attackers, 0, -1):
        total, clean = _hypotheses(team_size, attackers, s)
        if distinct and total - clean < sampling_budget:
            return s
        if sampling_budget * clean < confidence * total:
            continue  # the chances of all tries together do not add up to the confidence
        if exact_budget(team_size, attackers, s, confidence, distinct=distinct) <= sampling_budget:
            return s
    return 0


def _hypotheses(team_size: int, attackers: int, collaborators: int) -> tuple[int, int]:
    """How many subsets there are, and how many of them hold no attacker."""
    _check_team(team_size, attackers, collaborators)
    return math.comb(team_size, collaborators), math.comb(team_size - attackers, collaborators)


def _trials(success: float, confidence: float) -> int:
    """Independent trials until one succeeds with the given confidence."""
    if success >= 1.0:
        return 1
    try:
        return max(1, math.ceil(math.log1p(-confidence) / math.log1p(-success) - _ROUNDING))
    except (OverflowError, ZeroDivisionError) as error:
        raise DomainError("the chance of an attacker-free hypothesis is too small for any budget") from error


def _check_whole(name: str, value: int) -> None:
    if not isinstance(value, Integral):
        raise DomainError(f"{name} must be a whole number, got {value!r}")


def _check_at_least_one(name: str, value: int) -> None:
    _check_whole(name, value)
    if value < 1:
        raise DomainError(f"{name} must be at least 1, got {value}")


def _check_open_unit(name: str, value: float) -> None:
    if not isinstance(value, Real) or not 0.0 < value < 1.0:
        raise DomainError(f"{name} must lie strictly between 0 and 1, got {value!r}")


def _check_team(team_size: int, attackers: int, collaborators: int) -> None:
    _check_at_least_one("team_size", team_size)
    _check_whole("attackers", attackers)
    _check_whole("collaborators", collaborators)
    if not 0 <= attackers <= team_size:
        raise DomainError(f"attackers must be between 0 and the team size {team_size}, got {attackers}")
    if not 1 <= collaborators <= team_size:
        raise DomainError(f"collaborators must be between 1 and the team size {team_size}, got {collaborators}")
