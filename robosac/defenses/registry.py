"""Defences by name: those that ship, those of installed packages, and the user's own."""

from __future__ import annotations

import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from robosac import references
from robosac.budget import DomainError
from robosac.defenses.group_testing import Calibration
from robosac.defenses.protocol import Defense
from robosac.defenses.settings import DefenseSettings

GROUP = "robosac.defenses"
"""Under which installed packages offer theirs as entry points."""

Kinds = Mapping[str, type[DefenseSettings]]
"""Settings classes by their kind."""


@cache
def shipped() -> Kinds:
    """The defences that ship: whatever settings the modules of this package have."""
    kinds: dict[str, type[DefenseSettings]] = {}
    for found in pkgutil.iter_modules(sys.modules[str(__package__)].__path__):
        module = import_module(f"{__package__}.{found.name}")
        for value in vars(module).values():
            own = isinstance(value, type) and value.__module__.startswith(module.__name__)
            if own and issubclass(value, DefenseSettings) and value.name():
                kinds[value.name()] = value
    return kinds


def known(extra: Sequence[str] = ()) -> Kinds:
    """The defences that ship, and extra ones as `load` takes them.

    Raises
    ------
    DomainError
        If an extra one cannot be loaded, or is of a kind that is taken.
    """
    kinds = dict(shipped())
    for name in extra:
        settings = load(name)
        if kinds.setdefault(settings.kind, type(settings)) is not type(settings):
            raise DomainError(f"{name}: there is another defence of kind {settings.kind!r}")
    return kinds


def load(name: str) -> DefenseSettings:
    """A defence's settings, all at their defaults.

    Parameters
    ----------
    name : str
        A kind that ships, an entry point of `GROUP`, or ``module:callable``, where the callable takes no arguments and
        returns settings: a settings class will do.

    Raises
    ------
    DomainError
        If there is no such defence, or what is there is none.
    """
    if name in shipped():
        return shipped()[name](kind=name)
    reference = next((f"{point.module}:{point.attr}" for point in entry_points(group=GROUP, name=name)), name)
    if not references.is_reference(reference):
        raise DomainError(f"no defence {name!r}: give one of {', '.join(shipped())}, or module:callable")
    try:
        made = references.make(reference)
    except ValueError as error:
        raise DomainError(str(error)) from error
    if not isinstance(made, DefenseSettings):
        raise DomainError(f"{name} made no defence but {made!r:.200}: it has to derive from DefenseSettings")
    if type(made).name() != made.kind:
        raise DomainError(f"{name} made no defence: its kind has to be a Literal of one name")
    if made.makes is None and type(made).build is DefenseSettings.build:
        _check(made, name)
    return made


def read_settings(settings: Mapping[str, Any], kinds: Kinds | None = None) -> DefenseSettings:
    """Settings from what sessions and audit logs keep of them.

    Parameters
    ----------
    settings : mapping
        ``kind``, and settings of it; JSON values will do.
    kinds : mapping, optional
        The kinds to choose from; by default those that ship, and the entry points of `GROUP`.

    Raises
    ------
    DomainError
        If there is no such kind, or it does not take these settings.
    """
    kind = settings.get("kind")
    model = _find(kind, kinds) if isinstance(kind, str) else None
    if model is None:
        raise DomainError(f"no defence of kind {kind!r}; known: {', '.join(kinds or shipped())}")
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise DomainError(": ".join([str(kind), *map(str, first["loc"]), first["msg"]])) from error


def build(
    settings: DefenseSettings | Mapping[str, Any],
    calibration: Callable[[], Calibration] | None = None,
    kinds: Kinds | None = None,
) -> Defense:
    """Build a defence.

    Parameters
    ----------
    settings : DefenseSettings or mapping
        A mapping is read as `read_settings` does.
    calibration : callable, optional
        Gives the calibration of the detector that the defence is for; called only for one that needs it.
    kinds : mapping, optional
        As for `read_settings`.

    Raises
    ------
    DomainError
        If there is no such kind, it does not take these settings, or makes no defence of them.
    CalibrationError
        If a calibration is needed and there is none.
    """
    chosen = settings if isinstance(settings, DefenseSettings) else read_settings(settings, kinds)
    calibrated = calibration() if calibration is not None and chosen.needs_calibration else None
    try:
        defense = chosen.build(calibrated)
    except DomainError:
        raise
    except Exception as error:  # the user's code may raise anything
        raise DomainError(f"{chosen.kind}: {type(error).__name__}: {error}") from error
    _check(defense, chosen.kind)
    return defense


def _find(kind: str, kinds: Kinds | None) -> type[DefenseSettings] | None:
    if kinds is not None or kind in shipped() or not entry_points(group=GROUP, name=kind):
        return (kinds or shipped()).get(kind)
    return type(load(kind))


_PARTS = {
    name: (inspect.getdoc(part) or "").partition("\n")[0]
    for name, part in vars(Defense).items()
    if not name.startswith("_") and (callable(part) or isinstance(part, property))
}
"""All that a defence has to have, and what each is for."""


def _check(candidate: object, who: str) -> None:
    missing = [f"{name} ({purpose})" for name, purpose in _PARTS.items() if not hasattr(candidate, name)]
    if missing:
        raise DomainError(f"{who} made no defence but {candidate!r:.100}, which lacks {', '.join(missing)}")
