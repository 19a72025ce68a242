"""What a caller of the library may have got wrong, found before anything is computed and told by its name.

A fault inside does not fail a frame, so a caller's mistake would be answered as one.
"""

from __future__ import annotations

import operator
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from robosac.boxes import pose_fault
from robosac.budget import DomainError
from robosac.deadline import Deadline
from robosac.defenses import EGO, Defense
from robosac.detectors import DetectorInfo, Message
from robosac.detectors.base import Role
from robosac.plugins import lacks
from robosac.screening import Screening

_WIDEST = 8
"""Bytes of the widest numbers that torch has."""


def check_session(team: object, defense: object, saved: object, rng: object, screening: object) -> None:
    """Refuse what `robosac.Session` cannot be made of.

    Raises
    ------
    TypeError, ValueError
    """
    check_team(team)
    if defense is not None:
        check_defense(defense)
    if saved is not None and not _is_saved(saved):
        raise TypeError(f"saved must be what Session.save gave, got {saved!r:.100}")
    if rng is not None:
        check_rng(rng)
    if not isinstance(screening, Screening | None) and screening != "calibrated":
        raise TypeError(f'screening must be a Screening, None or "calibrated", got {screening!r}')


def _is_saved(saved: object) -> bool:
    parts = (("defense", str | None), ("state", Mapping), ("previous", Mapping | None))
    return isinstance(saved, Mapping) and all(isinstance(saved.get(name), kind) for name, kind in parts)


def check_team(team: object) -> None:
    """`TypeError` or `DomainError` for what is no team: one text would be a team of its letters."""
    if isinstance(team, str) or not isinstance(team, Collection):
        raise TypeError(f"team must be a sequence of ids, got {team!r}")
    check_ids("team", team)


def checked_number(frame: object) -> int:
    """A frame's number as a plain integer, which JSON can hold; `TypeError` for what is none.

    It is remembered, so anything else would cost the answers of later frames too.
    """
    try:
        return operator.index(frame)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"frame must be an integer, got {frame!r}") from None


def check_ids(field: str, names: Iterable[object]) -> None:
    """`DomainError` for an id that cannot be one: in the middle of a frame it would cost all answers."""
    known = set()
    for index, name in enumerate(names):
        if not isinstance(name, str):
            fault = f"is no text: {name!r}"
        elif name == EGO:
            fault = "is empty, which stands for the ego"
        elif not name.isascii() and name != name.encode(errors="ignore").decode():
            fault = f"cannot be written as UTF-8: {name!r}"
        elif name in known:
            fault = f"is there twice: {name!r}"
        else:
            known.add(name)
            continue
        raise DomainError(f"{field}: id {index} {fault}")


def check_defense(defense: object) -> None:
    """`TypeError` for what is no defence."""
    if lacking := lacks(defense, Defense):
        named = ", not its name" if isinstance(defense, str) else ""
        raise TypeError(f"defense must be a defence{named}, and {type(defense).__name__} {lacking}")


def check_rng(rng: object) -> None:
    """`TypeError` for what is no generator of random numbers."""
    if not isinstance(rng, np.random.Generator):
        raise TypeError(f"rng must be a numpy.random.Generator, got {rng!r}")


def check_deadline(deadline: object) -> None:
    """`TypeError` for what is no deadline, such as a number of seconds."""
    if not isinstance(deadline, Deadline | None):
        raise TypeError(f"deadline must be a robosac.deadline.Deadline or None, got {deadline!r}")


def check_frame(info: DetectorInfo, ego: Message, teammates: Mapping[str, Message]) -> None:
    """Refuse messages that are not of a detector's layout, and an ego that is nowhere; what the numbers of tensors are
    is not looked at.

    Raises
    ------
    TypeError, ValueError
    """
    if not isinstance(teammates, Mapping):
        raise TypeError("teammates must be a mapping of ids to messages")
    check_ids("teammates", teammates)
    _check_message(info, "ego", ego, "ego")
    if fault := pose_fault(ego.pose):
        raise ValueError(f"ego: the pose {fault}")
    for name, message in teammates.items():
        _check_message(info, "teammate", message, f"teammates[{name!r}]")


def _check_message(info: DetectorInfo, role: Role, message: object, name: str) -> None:
    if not isinstance(message, Message):
        raise TypeError(f"{name} must be a Message, got {type(message).__name__}")
    _check_array(f"{name}: the pose", message.pose, (4, 4), "numbers", "fiu")
    for tensor, spec in info.tensors[role].items():
        if tensor not in message.tensors:
            raise ValueError(f"{name}: the tensor {tensor!r} is missing")
        kind = np.dtype(spec.dtype).kind  # wider numbers will do
        _check_array(f"{name}: the tensor {tensor!r}", message.tensors[tensor], spec.shape, spec.dtype, kind)


def _check_array(what: str, array: object, shape: tuple[int, ...], wanted: str, kinds: str) -> None:
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{what} must be a numpy array, got {type(array).__name__}")
    if array.shape != shape:
        raise ValueError(f"{what} must be of shape {shape}, got {array.shape}")
    if array.dtype.kind not in kinds or array.dtype.itemsize > _WIDEST:
        raise ValueError(f"{what} must be of {wanted}, got {array.dtype}")


def by_text(value: object) -> bool:
    """Whether all keys of a JSON value are texts: JSON has no others, and some writers make texts of them."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and by_text(item) for key, item in value.items())
    return all(map(by_text, value)) if isinstance(value, list | tuple) else True
