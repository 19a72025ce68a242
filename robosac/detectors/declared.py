"""What a detector says of itself, looked at before it is used: one of one's own may say anything."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from robosac.detectors.base import DetectorError, DetectorInfo, Precision, Role, TensorSpec
from robosac.detectors.narrow import BYTES

_DIGEST_CHARS = 64
_NAME_CHARS = 128


def check_info(info: object, who: str) -> None:
    """Refuse a detector's face that cannot be.

    Parameters
    ----------
    info : object
        What should be a `DetectorInfo`.
    who : str
        Whose it is, for messages.

    Raises
    ------
    DetectorError
        That names the field.
    """
    if not isinstance(info, DetectorInfo):
        raise DetectorError(f"{who}: info must be a DetectorInfo, got a {type(info).__name__}")
    for name, wanted, is_so in _FIELDS:
        value = getattr(info, name)
        if not is_so(value):
            raise DetectorError(f"{who}: info.{name} must be {wanted}, got {value!r:.100}")
    for fault in _of_tensors(info.tensors):
        raise DetectorError(f"{who}: info.tensors {fault}")


def _of_tensors(tensors: object) -> Iterator[str]:
    for role in get_args(Role):
        specs = tensors.get(role) if isinstance(tensors, Mapping) else None
        if not isinstance(specs, Mapping):
            yield f"must have what the {role} sends, by name, under {role!r}"
            return
        for name, spec in specs.items():
            if not isinstance(spec, TensorSpec):
                yield f"must have a TensorSpec for {name!r} of the {role}, got {spec!r:.100}"
            elif not _is_dtype(spec.dtype):
                yield f"of the {role}: {name!r} must have a numpy dtype by its name, got {spec.dtype!r:.100}"
            elif not isinstance(spec.shape, tuple) or not all(type(n) is int and n > 0 for n in spec.shape):
                yield f"of the {role}: {name!r} must have a shape of positive integers, got {spec.shape!r:.100}"
            elif not isinstance(spec.narrower, tuple) or not all(map(_is_narrower, spec.narrower)):
                narrower = f"{spec.narrower!r:.100}"
                yield f"of the {role}: {name!r} must have a tuple of int8 and floats as narrower, got {narrower}"
            elif not _is_name(name):
                yield f"of the {role} must have names of at most {_NAME_CHARS} printable characters, got {name!r:.100}"


def _is_name(value: object) -> bool:
    return isinstance(value, str) and 0 < len(value) <= _NAME_CHARS and value.isprintable()


def _is_narrower(name: object) -> bool:
    return name == BYTES or (_is_dtype(name) and np.dtype(str(name)).kind == "f")


def _is_path(value: object) -> bool:
    return value is None or isinstance(value, Path)


def _is_dtype(name: object) -> bool:
    try:
        return isinstance(name, str) and np.dtype(name).kind in "biuf" and np.dtype(name).name == name
    except TypeError:
        return False


def _finite(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and bool(np.isfinite(value))


def _is_area(value: Any) -> bool:
    if not isinstance(value, tuple | list) or len(value) != 4 or not all(map(_finite, value)):
        return False
    return bool(value[0] < value[2] and value[1] < value[3])


def _is_digest(value: object) -> bool:
    return isinstance(value, str) and len(value) == _DIGEST_CHARS and set(value) <= set("0123456789abcdef")


_FIELDS = (
    ("name", f"a text of at most {_NAME_CHARS} printable characters", _is_name),
    ("area_m", "xmin, ymin, xmax, ymax in metres, each least below its most", _is_area),
    ("cell_m", "a positive number of metres", lambda value: _finite(value) and value > 0),
    ("weights_digest", "a SHA-256, 64 hexadecimal digits in lower case", _is_digest),
    ("consensus_score", "a score from 0 to 1", lambda value: _finite(value) and 0 <= value <= 1),
    ("calibration", "a Path or None", _is_path),
    ("witness", "a Path or None", _is_path),
    ("mirrored", "True or False", lambda value: isinstance(value, bool)),
    ("precision", f"one of {', '.join(get_args(Precision))}", lambda value: value in get_args(Precision)),
    ("device", "a text", lambda value: isinstance(value, str)),
)
