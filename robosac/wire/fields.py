"""Fields of a body that came over the wire: each is taken with its type checked, or refused by its path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SHOWN = 40
"""Characters of a sender's own words that an error repeats."""
_TYPES = {
    dict: "a map",
    list: "an array",
    str: "a string",
    bytes: "binary",
    type(None): "nil",
    int: "an integer",
    float: "a float",
    bool: "a boolean",
}


class WireError(ValueError):
    """A body that cannot be accepted.

    Attributes
    ----------
    code : str
        Stable and machine-readable: ``malformed-msgpack``, ``missing-field``, ``wrong-type``, ``wrong-dtype``,
        ``wrong-shape``, ``wrong-length``, ``bad-compression``, ``non-finite``, ``bad-pose``, ``out-of-range``,
        ``unknown-tensor``.
    field : str
        Path of the offending part, such as ``tensors.features.data``; empty for the body itself.
    detail : str
        What was wrong, for a human.
    """

    def __init__(self, code: str, field: str, detail: str) -> None:
        super().__init__(f"{field or 'body'}: {detail}")
        self.code = code
        self.field = field
        self.detail = detail


class Fields:
    """A map in a body, and its path there."""

    def __init__(self, value: Any, path: str = "") -> None:
        self.value: Mapping[Any, Any] = of_type(value, dict, path)
        self.path = path

    def at(self, name: str) -> str:
        return f"{self.path}.{name}" if self.path else name

    def take(self, name: str, kind: type | None = None) -> Any:
        """A field that has to be there, of a type if one is given."""
        if name not in self.value:
            raise WireError("missing-field", self.at(name), "is missing")
        return self.value[name] if kind is None else of_type(self.value[name], kind, self.at(name))

    def take_bytes(self, name: str, length: int) -> bytes:
        data: bytes = self.take(name, bytes)
        if len(data) != length:
            raise WireError("wrong-length", self.at(name), f"must be {length} bytes, got {len(data)}")
        return data


def named(parts: Mapping[Any, Any], path: str) -> Mapping[str, Any]:
    """Parts of which each has a name: a number is none, else ``"5"`` and ``5`` would be two parts of one vehicle."""
    for name in parts:
        if not isinstance(name, str):
            raise WireError("wrong-type", path, f"a name must be a string, got {type_of(name)} {shown(name)}")
    return parts


def of_type(value: Any, kind: type, path: str) -> Any:
    """A value that has to be of a type."""
    if type(value) is not kind:  # a bool is no integer
        raise WireError("wrong-type", path, f"must be {_TYPES[kind]}, got {type_of(value)}")
    return value


def type_of(value: Any) -> str:
    """The type of a value, in msgpack's words."""
    return _TYPES.get(type(value), type(value).__name__)


def shown(name: Any) -> str:
    """A sender's own words, as an error repeats them."""
    text = repr(str(name))
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
