"""Defences by name: those that ship, those of installed packages, and the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from robosac.budget import DomainError
from robosac.defenses.group_testing import Calibration
from robosac.defenses.protocol import Defense
from robosac.defenses.settings import DefenseSettings
from robosac.faults import in_words
from robosac.plugins import Kind

Kinds = Mapping[str, type[DefenseSettings]]
"""Settings classes by their kind."""


def _kind(candidate: type) -> str:
    return candidate.name() if issubclass(candidate, DefenseSettings) else ""


DEFENSES: Kind[DefenseSettings] = Kind("defence", str(__package__), DefenseSettings, _kind, error=DomainError)


def shipped() -> Kinds:
    """The defences that ship: whatever settings the modules of this package have."""
    return DEFENSES.shipped


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
        A kind that ships, an entry point of the group ``robosac.defenses``, or ``module:callable``, where the callable
        takes no arguments and returns settings: a settings class will do.

    Raises
    ------
    DomainError
        If there is no such defence, or what is there is none.
    """
    made = shipped()[name](kind=name) if name in shipped() else DEFENSES.make(name)
    if type(made).name() != made.kind:
        raise DomainError(f"{name} made no defence: its kind has to be a Literal of one name")
    if type(made).build is DefenseSettings.build:
        DEFENSES.check(made, Defense, name)
    return made


def read_settings(settings: Mapping[str, Any], kinds: Kinds | None = None) -> DefenseSettings:
    """Settings from what sessions and audit logs keep of them.

    Parameters
    ----------
    settings : mapping
        ``kind``, and settings of it; JSON values will do.
    kinds : mapping, optional
        The kinds to choose from; by default those that ship, and entry points of the group ``robosac.defenses``.

    Raises
    ------
    DomainError
        If there is no such kind, or it does not take these settings.
    """
    if not isinstance(settings, Mapping):
        raise DomainError(f"settings must be a mapping with a kind, got {settings!r}")
    kind = settings.get("kind")
    model = _find(kind, kinds) if isinstance(kind, str) else None
    if model is None:
        raise DomainError(f"no defence of kind {kind!r}; known: {', '.join(kinds or shipped())}")
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise DomainError(": ".join([str(kind), *map(str, first["loc"]), in_words(first)])) from error


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
    DEFENSES.check(defense, Defense, chosen.kind)
    return defense


def _find(kind: str, kinds: Kinds | None) -> type[DefenseSettings] | None:
    if kinds is not None or kind in shipped() or not entry_points(group=DEFENSES.package, name=kind):
        return (kinds or shipped()).get(kind)
    return type(load(kind))
