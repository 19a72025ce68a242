"""What an attack is given and returns, looked at before it is used: attacks of one's own return anything."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TypeVar

import numpy as np
import torch

from robosac.attacks.situation import Lie
from robosac.detectors.base import AttackSurface, Message

T = TypeVar("T")

_OF_NUMPY = frozenset(
    torch.from_numpy(np.empty(0, kind)).dtype for kind in ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "?")
)


class AttackError(ValueError):
    """What an attack made, or was given, is not what it has to be."""


class NoSuchAttacker(AttackError, KeyError):
    """Somebody who sends nothing in the frame is to attack in it."""

    __str__ = Exception.__str__  # a KeyError shows its message in quotes


def of_attackers(messages: Mapping[str, T], attackers: Collection[str]) -> dict[str, T]:
    """The attackers' messages, sorted by their names.

    Raises
    ------
    TypeError
        If one text is given in the place of several names.
    NoSuchAttacker
        If an attacker has no message.
    """
    if isinstance(attackers, str):
        raise TypeError(f"attackers must be a collection of names, got the text {attackers!r}")
    if absent := [name for name in attackers if name not in messages]:
        raise NoSuchAttacker(f"the attacker {absent[0]!r} sends nothing in this frame; {', '.join(messages)} do")
    return {name: messages[name] for name in sorted(attackers)}


def check_returned(name: str, sent: object, surface: AttackSurface, acting: Collection[str]) -> None:
    """Refuse what is no mapping of attackers to finite tensors of the shapes of their benign messages.

    Parameters
    ----------
    name : str
        The attack's.
    sent : object
        What its ``run`` returned.
    surface : AttackSurface
        What it was given.
    acting : collection of str
        The attackers that it was given.

    Raises
    ------
    AttackError
        That says which part is wrong.
    """
    if not isinstance(sent, Mapping):
        raise AttackError(f"{name}: run must return a mapping of attackers to tensors, got a {type(sent).__name__}")
    for vehicle, tensor in sent.items():
        if vehicle not in acting:
            attackers = ", ".join(acting)
            raise AttackError(f"{name}: run returned a message of {vehicle!r}; the attackers are {attackers}")
        part, benign = f"{name}: the message of {vehicle!r} that run returned", surface.messages[vehicle]
        if not isinstance(tensor, torch.Tensor):
            raise AttackError(f"{part} must be a tensor, got a {type(tensor).__name__}")
        if tensor.shape != benign.shape:
            raise AttackError(f"{part} must be of shape {tuple(benign.shape)}, got {tuple(tensor.shape)}")
        if tensor.is_complex():
            raise AttackError(f"{part} must be of real numbers, got {tensor.dtype}")
        if tensor.layout is not torch.strided or tensor.dtype not in _OF_NUMPY:
            raise AttackError(f"{part} must be dense, of a type that numpy has, got {tensor.dtype}, {tensor.layout}")
        if not torch.isfinite(tensor).all():
            raise AttackError(f"{part} holds NaN or infinity")


def check_sent(name: str, sent: Mapping[str, Message], lies: Sequence[object]) -> None:
    """Refuse what became of it: numbers that a message cannot hold, and lies that are none.

    Parameters
    ----------
    name : str
        The attack's.
    sent : mapping of attacker to Message
        Its messages, in the types of the detector.
    lies : sequence of object
        What it says that it lies about.

    Raises
    ------
    AttackError
        That says which part is wrong.
    """
    for vehicle, message in sent.items():
        for tensor, values in message.tensors.items():
            if not np.isfinite(values).all():
                part = f"{name}: the message of {vehicle!r} that run returned"
                raise AttackError(
                    f"{part} holds numbers too large for the tensor {tensor!r}, which is of {values.dtype}"
                )
    for lie in lies:
        if not isinstance(lie, Lie):
            raise AttackError(f"{name}: situation.lies must hold each a Lie, got {lie!r:.100}")
        if lie.kind in ("moved", "reshaped") and lie.truth is None:
            raise AttackError(f"{name}: a lie of kind {lie.kind!r} needs the true box of its vehicle")


def check_prepared(name: str, attacking: object) -> None:
    """Refuse what does not say whether to attack: without a word nobody would.

    Raises
    ------
    AttackError
        If it is neither True nor False.
    """
    if not isinstance(attacking, bool | np.bool_):
        raise AttackError(f"{name}: prepare must return True or False, got {attacking!r:.100}")


def check_aim(name: str, value: object) -> None:
    """Refuse an aim that cannot be descended.

    Raises
    ------
    AttackError
        If it is not one number that follows from the attackers' messages.
    """
    if not isinstance(value, torch.Tensor):
        got = f"a {type(value).__name__}"
    elif value.numel() != 1:
        got = f"a tensor of shape {tuple(value.shape)}"
    elif not value.requires_grad:
        got = "a number that does not depend on them"
    elif value.isnan():
        got = "NaN"
    else:
        return
    raise AttackError(f"{name}: what is minimised must be one number that follows from the messages, got {got}")
