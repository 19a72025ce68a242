"""A defence from its settings, as sessions and audit logs keep them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from robosac.budget import DomainError
from robosac.defenses.a2cp import A2CP
from robosac.defenses.conformal import Conformal
from robosac.defenses.group_testing import DEFAULT_HAZARDS, Calibration, CalibrationError, GroupTesting, Hazards
from robosac.defenses.halving import Halving
from robosac.defenses.one_by_one import OneByOne
from robosac.defenses.protocol import Defense, Reference
from robosac.defenses.sample_consensus import SampleConsensus
from robosac.defenses.static_team import StaticTeam
from robosac.defenses.undefended import Undefended

_KINDS: Mapping[str, type[Any]] = {
    cls.kind: cls for cls in (SampleConsensus, StaticTeam, A2CP, Halving, OneByOne, Conformal, Undefended)
}


def build(settings: Mapping[str, Any], calibration: Callable[[], Calibration] | None = None) -> Defense:
    """Build a defence.

    Parameters
    ----------
    settings : mapping
        ``kind``, and arguments of its class; JSON values will do. Of ``group_testing`` the hazards are given one by one
        (``hijack``, ``recovery``, ``kind_change``), and ``pose_error_m``, the pose error to expect.
    calibration : callable, optional
        Gives the calibration of the detector that the defence is for; only ``group_testing`` asks.

    Raises
    ------
    DomainError
        If there is no such kind, or it does not take these settings.
    CalibrationError
        If a calibration is needed and there is none.
    """
    options: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in settings.items()}
    kind = options.pop("kind", None)
    if kind not in (*_KINDS, GroupTesting.kind):
        raise DomainError(f"no defence of kind {kind!r}; known: {', '.join((*_KINDS, GroupTesting.kind))}")
    try:
        if kind == GroupTesting.kind:
            return _group_testing(calibration, **options)
        if "reference" in options:
            options["reference"] = Reference(options["reference"])
        defense: Defense = _KINDS[kind](**options)
    except DomainError:
        raise
    except (TypeError, ValueError) as error:
        raise DomainError(f"{kind}: {error}") from error
    return defense


def _group_testing(
    calibration: Callable[[], Calibration] | None,
    hijack: float = DEFAULT_HAZARDS.hijack,
    recovery: float = DEFAULT_HAZARDS.recovery,
    kind_change: float = DEFAULT_HAZARDS.change,
    **settings: Any,
) -> Defense:
    if calibration is None:
        raise CalibrationError("group_testing needs the calibration of a detector")
    return GroupTesting.calibrated(calibration(), hazards=Hazards(hijack, recovery, kind_change), **settings)
