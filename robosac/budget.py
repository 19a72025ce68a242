"""How many hypotheses to test, and how many collaborators can be had for that.

Notation of the paper (*Among Us: Adversarially Robust Collaborative Perception by Consensus*, ICCV 2023): team size S
(teammates without the ego), attackers A, attacker ratio eta = A / S, collaborators s in a hypothesis, sampling budget
N, confidence p. The paper's Eq. 1 and Eq. 2 treat the members of a hypothesis as drawn independently; in truth they are
drawn without replacement, and the exact law is hypergeometric. Both are here: `eq1_collaborators` and `eq2_budget` are
the paper's, `exact_collaborators` and `exact_budget` what the gateway uses.
"""

from __future__ import annotations

import math

DEFAULT_CONFIDENCE = 0.99
_ENUMERABLE = 100_000
"""Up to so many hypotheses the law of distinct draws is summed up exactly."""
_ROUNDING = 1e-9
"""Slack under which a quotient counts as the whole number it misses by floating point."""


class DomainError(ValueError):
    """An argument lies outside the domain of a budget formula."""


def eq1_collaborators(sampling_budget: int, attacker_ratio: float, confidence: float = DEFAULT_CONFIDENCE) -> int:
    """The paper's Eq. 1: ``floor(ln(1 - (1-p)^(1/N)) / ln(1-eta))``, collaborators guaranteed by a budget.

    Parameters
    ----------
    sampling_budget : int
        N >= 1.
    attacker_ratio : float
        0 < eta < 1.
    confidence : float
        0 < p < 1.

    Returns
    -------
    int
        s >= 0; not bounded by a team size, which the formula does not know.

    Raises
    ------
    DomainError
        If an argument is outside its range, or too close to its ends for floating point.
    """
    _check_budget(sampling_budget)
    _check_open_unit("attacker_ratio", attacker_ratio)
    _check_open_unit("confidence", confidence)
    clean_needed = -math.expm1(math.log1p(-confidence) / sampling_budget)
    try:
        return math.floor(math.log(clean_needed) / math.log1p(-attacker_ratio) + _ROUNDING)
    except (OverflowError, ValueError) as error:
        raise DomainError("the arguments are too close to 0 or 1 for the formula") from error


def eq2_budget(collaborators: int, attacker_ratio: float, confidence: float = DEFAULT_CONFIDENCE) -> int:
    """The paper's Eq. 2: ``ceil(ln(1-p) / ln(1 - (1-eta)^s))``, hypotheses needed for s collaborators.

    Parameters
    ----------
    collaborators : int
        s >= 1.
    attacker_ratio : float
        0 < eta < 1.
    confidence : float
        0 < p < 1.

    Returns
    -------
    int
        N >= 1.

    Raises
    ------
    DomainError
        If an argument is outside its range, or so many collaborators are asked for that N is not a finite number.
    """
    if collaborators < 1:
        raise DomainError(f"collaborators must be at least 1, got {collaborators}")
    _check_open_unit("attacker_ratio", attacker_ratio)
    _check_open_unit("confidence", confidence)
    return _trials((1.0 - attacker_ratio) ** collaborators, confidence)


def attackers_in_team(team_size: int, attacker_ratio: float) -> int:
    """Attackers that a ratio means for a team: eta * S, rounded up, so that a fraction of an attacker counts as one.

    Raises
    ------
    DomainError
        If the team is empty or the ratio is not in [0, 1].
    """
    if team_size < 1:
        raise DomainError(f"team_size must be at least 1, got {team_size}")
    if not 0.0 <= attacker_ratio <= 1.0:
        raise DomainError(f"attacker_ratio must be in [0, 1], got {attacker_ratio}")
    return math.ceil(attacker_ratio * team_size - _ROUNDING)


def clean_probability(team_size: int, attackers: int, collaborators: int) -> float:
    """Chance that a random hypothesis holds no attacker: ``q = C(S-A, s) / C(S, s)``.

    Parameters
    ----------
    team_size, attackers, collaborators : int
        S >= 1, 0 <= A <= S, 1 <= s <= S.

    Returns
    -------
    float
        In [0, 1]; 0 if more collaborators are asked for than benign teammates exist.

    Raises
    ------
    DomainError
        If an argument is outside its range.
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

    Parameters
    ----------
    team_size, attackers, collaborators : int
        S >= 1, 0 <= A <= S, 1 <= s <= S - A.
    confidence : float
        0 < p < 1.
    distinct : bool, default True
        Whether no hypothesis is tried twice. Then the first n tries all fail with probability ``C(D, n) / C(T, n)``,
        where T hypotheses exist and D of them hold an attacker, and D + 1 tries always suffice. Otherwise tries are
        independent: ``ceil(ln(1-p) / ln(1-q))``.

    Returns
    -------
    int
        N >= 1; the least that suffices, except for distinct hypotheses when there are more than 100,000 of them: then
        it is the smaller of two bounds that always suffice, the independent one and ``T (1 - (1-p)^(1/(T-D)))``.

    Raises
    ------
    DomainError
        If an argument is outside its range, or no attacker-free hypothesis exists.
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
    """Most collaborators for which a budget suffices by `exact_budget`; 0 if it does not suffice for one.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """
    _check_budget(sampling_budget)
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


def _check_budget(sampling_budget: int) -> None:
    if sampling_budget < 1:
        raise DomainError(f"sampling_budget must be at least 1, got {sampling_budget}")


def _check_open_unit(name: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise DomainError(f"{name} must lie strictly between 0 and 1, got {value}")


def _check_team(team_size: int, attackers: int, collaborators: int) -> None:
    if team_size < 1:
        raise DomainError(f"team_size must be at least 1, got {team_size}")
    if not 0 <= attackers <= team_size:
        raise DomainError(f"attackers must be between 0 and the team size {team_size}, got {attackers}")
    if not 1 <= collaborators <= team_size:
        raise DomainError(f"collaborators must be between 1 and the team size {team_size}, got {collaborators}")
