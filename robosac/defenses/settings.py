"""What a defence's file says of the defence: its settings, and how it is made of them."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any, ClassVar, LiteralString, Self, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.protocol import Defense, Reference

if TYPE_CHECKING:
    from robosac.defenses.group_testing import Calibration

LEAST = 1e-9
"""Smaller numbers mean 0 in metres, milliseconds and probabilities alike, but vanish in products and quotients."""
LARGEST_INTEGER = 2**53 - 1
"""JSON keeps larger integers only roughly (RFC 8785)."""


def check_numbers(value: object) -> object:
    """Refuse numbers that break arithmetic or a log though their bounds allow them; other values are given back.

    Raises
    ------
    ValueError
        If a number is nearer to 0 than `LEAST` without being 0, or an integer beyond `LARGEST_INTEGER`; or one in a
        tuple or list is.
    """
    if isinstance(value, float) and 0 < abs(value) < LEAST:
        raise ValueError(f"is nearer to 0 than {LEAST:g}")
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        raise ValueError(f"must be at most {LARGEST_INTEGER}")
    if isinstance(value, tuple | list):
        for part in value:
            check_numbers(part)
    return value


def check_kinds(model: type[BaseModel], values: object) -> object:
    """Refuse what would only be read as a number or a truth value: true as 1, text as a number; others are given back.

    Raises
    ------
    ValidationError
        If a field's value, or a part of it, is of another kind than the model says.
    """
    faults = []
    for name, value in values.items() if isinstance(values, dict) else ():
        field = model.model_fields.get(name)
        fault = None if field is None else _fault(value, _kinds(field.annotation))
        if fault is not None:
            faults.append(InitErrorDetails(type=PydanticCustomError("kind", fault), loc=(name,), input=value))
    if faults:
        raise ValidationError.from_exception_data(model.__name__, faults)
    return values


def _fault(value: object, kinds: set[type]) -> LiteralString | None:
    if isinstance(value, tuple | list):
        return next((fault for part in value if (fault := _fault(part, kinds))), None)
    if not kinds or not kinds <= {int, float, bool} or not isinstance(value, bool | int | float | str | bytes):
        return None
    if bool in kinds:
        return None if isinstance(value, bool) else "must be true or false"
    return "must be a number" if isinstance(value, bool | str | bytes) else None


def _kinds(annotation: object) -> set[type]:
    """The plain types that an annotation names, at any depth."""
    if parts := get_args(annotation):
        return set().union(*map(_kinds, parts))
    return {kind for kind in (int, float, bool, str, bytes) if annotation is kind}


def _say_in_short(schema: dict[str, Any], model: type[DefenseSettings]) -> None:
    """In the API's description a line says what a defence does, and sessions have to say which one they want."""
    schema["description"] = model.summary()
    schema["required"] = ["kind", *(name for name in schema.get("required", ()) if name != "kind")]


class DefenseSettings(BaseModel):
    """Settings of a defence, as sessions and audit logs keep them.

    A subclass has ``kind``, a literal of its one name; a field for each setting, with type, bounds, default and
    description; and a docstring whose first line says what the defence does. One that assumes a share of attackers has
    a setting ``attacker_ratio``. It has the methods of `Defense`, or a `build` that gives an object that has them.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, json_schema_extra=_say_in_short)

    needs_calibration: ClassVar[bool] = False
    """Whether the defence works only with what ``robosac calibrate`` has made for the detector."""
    budgets: ClassVar[tuple[str, ...]] = ()
    """Settings that say how many hypotheses a frame may take."""
    kind: str

    @model_validator(mode="before")
    @classmethod
    def _check_kinds(cls, values: object) -> object:
        return check_kinds(cls, values)

    @field_validator("*")
    @classmethod
    def _check_numbers(cls, value: object) -> object:
        return check_numbers(value)

    @classmethod
    def name(cls) -> str:
        """The kind that all of this class have; empty for a class that only others derive from."""
        names = get_args(cls.model_fields["kind"].annotation)
        return names[0] if len(names) == 1 and isinstance(names[0], str) else ""

    @classmethod
    def summary(cls) -> str:
        """What the defence does, in a line."""
        return (inspect.getdoc(cls) or "").partition("\n")[0]

    def at_period(self, frame_period_ms: float) -> Self:  # noqa: ARG002
        """With what is left open decided for frames so far apart."""
        return self

    def at_calibration(self, calibration: Calibration) -> Self:  # noqa: ARG002
        """With what is left open decided by the detector's calibration."""
        return self

    def build(self, calibration: Calibration | None) -> Defense:  # noqa: ARG002
        """The defence: these settings themselves, unless this is overridden.

        Parameters
        ----------
        calibration : Calibration or None
            That of the detector the defence is for; None unless ``needs_calibration``.

        Raises
        ------
        robosac.budget.DomainError
            If the settings contradict each other, or the calibration does not do.
        """
        return cast(Defense, self)


class ConsensusSettings(DefenseSettings):
    """Settings of a defence that compares with a reference of one's choice."""

    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    reference: Reference = Field(Reference.EGO, description="What a hypothesis is compared with.")
