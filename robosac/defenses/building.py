"""A defence from its settings, as sessions and audit logs keep them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robosac.budget import DomainError
from robosac.defenses.a2cp import A2CP
from robosac.defenses.conformal import Conformal
from robosac.defenses.halving import Halving
from robosac.defenses.one_by_one import OneByOne
from robosac.defenses.protocol import Defense, Reference
from robosac.defenses.sample_consensus import SampleConsensus
from robosac.defenses.static_team import StaticTeam
from robosac.defenses.undefended import Undefended

_KINDS: Mapping[str, type[Any]] = {
    cls.kind: cls for cls in (SampleConsensus, StaticTeam, A2CP, Halving, OneByOne, Conformal, Undefended)
}


def build(settings: Mapping[str, Any]) -> Defense:
    """Build a defence.

    Parameters
    ----------
    settings : mapping
        ``kind``, and arguments of its class; JSON values will do.

    Raises
    ------
    DomainError
        If there is no such kind, or it does not take these settings.
    """
    options: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in settings.items()}
    kind = options.pop("kind", None)
    if kind not in _KINDS:
        raise DomainError(f"no defence of kind {kind!r}; known: {', '.join(_KINDS)}")
    try:
        if "reference" in options:
            options["reference"] = Reference(options["reference"])
        defense: Defense = _KINDS[kind](**options)
    except DomainError:
        raise
    except (TypeError, ValueError) as error:
        raise DomainError(f"{kind}: {error}") from error
    return defense
